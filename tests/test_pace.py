"""A learner that is slow says once what would make it faster."""

import warnings

import pytest
from cases import each
from small_models import small

from sb3_hds.algos.base import pace
from sb3_hds.algos.base.pace import Pace


class Learner:
    """Collects steps in no time, and counts updates."""

    def __init__(self) -> None:
        self._n_updates = 0

    def remedies(self, updates_per_step: float) -> list[str]:
        return [f"{updates_per_step:g} updates"]


def said(monkeypatch, seconds: list[float], n_updates: int = 1, n_steps: int = 1) -> list[str]:
    """By a learner whose calls of ``train`` take these times."""
    now, learner, looking = 0.0, Learner(), Pace()
    monkeypatch.setattr(pace.time, "perf_counter", lambda: now)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for each in seconds:
            now += 1_000.0  # of the environment
            looking.collected(learner, n_steps)
            learner._n_updates += n_updates
            now += each
            looking.updated(learner)
    return [str(each.message) for each in caught]


def test_a_slow_learner_says_so_once_after_seconds_and_what_compiles_does_not_count(monkeypatch):
    compiling = [30.0, 30.0]

    # 1.4 s for each: ten seconds, not two minutes.
    assert not said(monkeypatch, compiling + 7 * [1.4])
    assert len(said(monkeypatch, compiling + 8 * [1.4])) == 1
    # 100 updates of 0.25 s: 4 steps/s.
    [text] = said(monkeypatch, compiling + 300 * [0.25])
    assert "4 steps/s" in text and text.endswith("1 updates.")


@each(
    (0.19, 1, 1, False),
    (0.21, 20, 1, True),
    (0.21, 1, 2, False),  # of two environments
    (3.0, 200, 10, True),  # an episode
)
def test_it_goes_by_steps_of_the_environment(seconds, n_updates, n_steps, slow, monkeypatch):
    found = said(monkeypatch, 200 * [seconds], n_updates, n_steps)
    assert len(found) == slow and (not slow or f"{n_updates / n_steps:g} updates" in found[0])


def test_a_learner_says_which_of_its_arguments_matters(monkeypatch):
    monkeypatch.setattr(pace, "_SLOW", 1e9)
    monkeypatch.setattr(pace, "_UPDATES", 1)
    model = small("droq", learning_starts=5)

    with pytest.warns(UserWarning, match="DroQ makes .* steps/s") as caught:
        model.learn(60)
        model.learn(60)

    [text] = [str(each.message) for each in caught if "steps/s" in str(each.message)]
    assert "train_freq=20 with gradient_steps=2" in text and text.endswith("a GPU.")


def test_wide_critics_and_many_updates_are_named():
    kwargs = {"net_arch": {"pi": [8], "qf": [300, 8]}}
    model = small("crossq_jax", batch_size=512, policy_kwargs=kwargs)

    assert model.remedies(20.0) == [
        "policy_kwargs={'net_arch': {'pi': [8], 'qf': [256, 256]}}, with critics of [300, 8] now",
        "fewer gradient_steps, 20 for each step now",
        "batch_size=256, 512 now",
        "a GPU",
    ]
    assert "n_rollouts=2, 8 now" in small("hds").remedies(1.0)
