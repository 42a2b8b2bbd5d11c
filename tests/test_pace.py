"""A learner that is slow says once what would make it faster."""

import warnings

import pytest
from small_models import EVERY_OFF_POLICY, PLANNERS, small

from sb3_hds import CrossQ
from sb3_hds.algos import pace
from sb3_hds.algos.pace import Pace

pytestmark = pytest.mark.usefixtures("quick_compilation")


class Clock:
    """:param seconds: that updates take"""

    def __init__(self, seconds: float) -> None:
        self.now, self.seconds = 0.0, seconds

    def perf_counter(self) -> float:
        return self.now


class Learner:
    """Collects steps in no time, and counts updates."""

    def __init__(self) -> None:
        self._n_updates = 0

    def remedies(self, updates_per_step: float) -> list[str]:
        return [f"{updates_per_step:g} updates"]


def said(monkeypatch, seconds: list[float], n_updates: int = 1, n_steps: int = 1) -> list[str]:
    """
    :param seconds: that the calls of ``train`` take, one after the other
    :param n_updates: in each of them
    :param n_steps: between them
    """
    clock, learner, looking = Clock(0.0), Learner(), Pace()
    monkeypatch.setattr(pace.time, "perf_counter", lambda: clock.now)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for each in seconds:
            clock.now += 1_000.0  # of the environment
            looking.collected(learner, n_steps)
            learner._n_updates += n_updates
            clock.now += each
            looking.updated(learner)
    return [str(each.message) for each in caught]


def test_a_slow_learner_says_so_once_and_what_compiles_does_not_count(monkeypatch):
    compiling = [30.0, 30.0]

    # 100 updates of 0.25 s: 4 steps/s.
    [text] = said(monkeypatch, compiling + 300 * [0.25])

    assert text == (
        "Learner makes 4 steps/s, since the updates for each of them take 0.25 s. What would make "
        "it faster: 1 updates."
    )


@pytest.mark.parametrize(
    ("seconds", "n_updates", "n_steps", "slow"),
    [
        (0.19, 1, 1, False),
        (0.21, 1, 1, True),
        (0.21, 1, 2, False),  # of two environments
        (0.21, 20, 1, True),
        (3.0, 200, 10, True),  # an episode
        (0.3, 20, 2, False),
    ],
)
def test_it_goes_by_steps_of_the_environment(monkeypatch, seconds, n_updates, n_steps, slow):
    found = said(monkeypatch, 200 * [seconds], n_updates, n_steps)

    assert len(found) == slow
    assert not slow or f"{n_updates / n_steps:g} updates" in found[0]


def test_a_very_slow_learner_says_so_after_seconds(monkeypatch):
    # 1.4 s for each: ten seconds, not two minutes.
    assert len(said(monkeypatch, [30.0, 30.0] + 8 * [1.4])) == 1
    assert not said(monkeypatch, [30.0, 30.0] + 7 * [1.4])


@pytest.mark.parametrize("name", EVERY_OFF_POLICY)
def test_every_learner_says_which_of_its_arguments_matters(name, monkeypatch):
    monkeypatch.setattr(pace, "_SLOW", 1e9)
    monkeypatch.setattr(pace, "_UPDATES", 1)
    changes = {"train_freq": 10} if name in PLANNERS else {"learning_starts": 5}
    model = small(name, **changes)

    with pytest.warns(UserWarning, match=f"{type(model).__name__} makes .* steps/s") as caught:
        model.learn(60)
        model.learn(60)

    [text] = [str(each.message) for each in caught if "steps/s" in str(each.message)]
    expected = "n_rollouts=2, 8 now" if name in PLANNERS else "train_freq=20 with gradient_steps=2"
    assert expected in text and text.endswith("a GPU.")


def test_wide_critics_and_many_updates_are_named():
    model = CrossQ(
        "MlpPolicy",
        "Pendulum-v1",
        buffer_size=10,
        batch_size=512,
        policy_kwargs={"net_arch": {"pi": [8], "qf": [300, 8]}},
    )

    assert model.remedies(20.0) == [
        "policy_kwargs={'net_arch': {'pi': [8], 'qf': [256, 256]}}, with critics of [300, 8] now",
        "fewer gradient_steps, 20 for each step now",
        "batch_size=256, 512 now",
        "a GPU",
    ]
