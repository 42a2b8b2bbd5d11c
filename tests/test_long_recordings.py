"""Recordings that are too long for memory: stretches from all over them are used."""

import numpy as np
import pytest

from sb3_hds import twins
from sb3_hds.core import Trajectories
from sb3_hds.sysid.diagnosis import preparation
from sb3_hds.sysid.diagnosis.preparation import shortened_to

TWIN = twins.make("LinearAxis", dt=0.01)


def swinging(*lengths, period=1.0):
    """Commands count the steps."""
    obs = []
    for n in lengths:
        phase = 2.0 * np.pi * 0.01 * np.arange(n + 1) / period
        obs.append(np.stack([np.sin(phase), 2.0 * np.pi * np.cos(phase) / period], 1))
    actions = [np.arange(n, dtype=float)[:, None] for n in lengths]
    return Trajectories.from_arrays(obs, actions, dt=0.01, conditions=list(map(str, lengths)))


@pytest.fixture(autouse=True)
def little_memory(monkeypatch):
    monkeypatch.setattr(preparation, "_MOST_ROWS", 20_000)


def test_what_fits_stays_as_it_is():
    data = swinging(9_000, 11_000)
    assert shortened_to(TWIN, data) == (data, ())


def test_stretches_come_from_all_over_long_recordings():
    data = swinging(60_000, 100_000)

    cut, (sentence,) = shortened_to(TWIN, data)

    assert cut.n_steps == 20_000 and set(cut.lengths) == {1_000}
    assert "Of 1600 s, 200 s are used: 20 stretches of 10 s" in sentence
    assert set(cut.conditions) == {"60000", "100000"}
    # One stretch out of every eight thousand steps, somewhere in them.
    begins = cut.actions[:, 0, 0] + 60_000 * cut.origin
    assert np.bincount((begins // 8_000).astype(int)).tolist() == [1] * 20
    assert len(set(begins % 8_000)) > 3


def test_what_moves_slowly_is_thinned_before_it_is_cut():
    data = swinging(60_000, period=4.0)
    assert shortened_to(TWIN, data)[0] is data


def test_recordings_shorter_than_a_stretch_give_shorter_ones():
    data = swinging(*[400] * 100)
    cut, _ = shortened_to(TWIN, data)
    assert set(cut.lengths) == {400} and len(cut) == 50
