"""What was learned from is never held out afterwards, whatever happens to the data meanwhile."""

import gymnasium
import numpy as np
import pytest
from measuring import measured
from small_models import small

from sb3_hds import HDS, twins
from sb3_hds.algos.twin.hds import correction
from sb3_hds.errors import CalibrationError
from sb3_hds.sysid.estimation.prediction import hold_out

REAL = "sb3_hds/PendulumReal-v1"


class Sides:
    """Measured rows that were learned from so far; noise makes each of them one of a kind."""

    def __init__(self) -> None:
        self.learned: set[bytes] = set()
        self.held: set[bytes] = set()
        self.n_corrections = 0

    def __call__(self, twin, names, shots, origin, spread, **options):
        learned = self._rows(shots.obs[shots.weight > 0.0])
        held = self._rows(shots.obs[(shots.weight == 0.0) & (origin >= 0)])
        assert held and learned and not held & (self.learned | learned)
        self.learned |= learned
        self.held |= held
        self.n_corrections += 1
        raise CalibrationError("Only looking.")

    @staticmethod
    def _rows(obs: np.ndarray) -> set[bytes]:
        return {row.tobytes() for row in obs.reshape(-1, obs.shape[-1])}


@pytest.fixture
def sides(monkeypatch):
    found = Sides()
    monkeypatch.setattr(correction, "fit_windows", found)
    return found


def real(steps, **changes):
    settings = {"mass": 1.4, "noise": 0.01} | changes
    return gymnasium.make(REAL, max_episode_steps=steps, **settings)


def model_in(env, **changes):
    settings = {"twin": "PendulumReal", "beta": 0.0, "train_freq": 50, "pretrain_epochs": 0}
    return small("hds", env, **settings | changes)


def windows_of(lengths, n_steps):
    """Of the latest 128 windows of ten steps: number of the recording, and place in it."""
    found, i = [], 0
    while n_steps > 0:
        n = min(int(lengths[i % len(lengths)]), n_steps)
        found += [(i, k) for k in range((n + 1) // 11)]
        n_steps, i = n_steps - n, i + 1
    return np.array(found[-128:])


@pytest.mark.parametrize("longest", [15, 5000])
def test_windows_keep_their_side_while_recordings_come(longest):
    lengths = np.random.default_rng(longest).integers(11, longest, 50)
    learned, held, settled = set(), set(), False
    for n_steps in range(100, 5000, 50):
        windows = windows_of(lengths, n_steps)
        if len(windows) < 6:
            continue
        number, place = windows.T
        few = len(windows) < 24
        kept = hold_out(number, place, 0.5 if few else 0.25)
        now_held, now_learned = ({*map(tuple, windows[side])} for side in (kept, ~kept))
        assert now_held and now_learned and not now_held & learned
        if settled:
            assert not now_learned & held
        learned, held = learned | now_learned, (held if settled else set()) | now_held
        settled = not few and number.max() >= 3
    assert 0.1 < np.mean(kept) < 0.4


def test_what_was_learned_from_is_not_held_out_when_the_oldest_steps_are_overwritten(sides):
    model_in(real(60), buffer_size=400).learn(900)
    assert sides.n_corrections > 9


@pytest.mark.expensive
def test_nor_after_data_from_a_file_a_change_and_loading(sides, tmp_path):
    early = measured(twins.make("PendulumReal", mass=1.4), n=6, noise=0.01)
    env = real(130, noise=0.001)
    model = model_in(env, pretrain_data=early, max_saved_steps=900, buffer_size=4000).learn(500)
    env.unwrapped.set_payload(0.5)
    model.learn(1000, reset_num_timesteps=False)
    assert model._changed_at is not None
    model.save(tmp_path / "model")
    n_before = sides.n_corrections

    # Other noise: the same seed would draw the same rows again.
    loaded = HDS.load(tmp_path / "model", env=real(60, noise=0.011))
    loaded.learn(500, reset_num_timesteps=False)

    assert sides.n_corrections > n_before + 5 > 25
