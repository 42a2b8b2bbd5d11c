"""What the benchmark of speed makes of what it measured."""

import threading

import numpy as np
import pandas as pd
import pytest
import runs
import speed


def measured() -> pd.DataFrame:
    """Of SAC: 1.2 times SBX; 4.8 times SB3 with one update per step, 9 with twenty."""
    rows = [
        ("sac", 1, "sbx", 1.2),
        ("sac", 20, "sbx", 1.2),
        ("sac", 1, "sb3", 4.8),
        ("sac", 20, "sb3", 9.0),
        ("droq", 20, "sbx", 1.5),
        ("sac", 4, "compiled", None),
    ]
    table = pd.DataFrame(rows, columns=["name", "ratio", "peer", "speed_up"])
    return table.assign(low=table["speed_up"], high=table["speed_up"])


def test_speed_ups_stand_beside_what_they_shall_be():
    shown = speed.beside_targets(measured()).set_index(["name", "ratio", "peer"])

    assert shown["wanted"].tolist() == [1.0, 1.3, 3.0, 3.0, 1.3]
    assert shown["reached"].tolist() == ["yes", "no", "yes", "yes", "yes"]


def test_the_speed_up_is_that_of_neighbouring_blocks(monkeypatch):
    # The machine slows down; ours takes half the time of the peer but in one block.
    blocks = [[0.5 * i, 1.0 * i] for i in range(1, speed.N_BLOCKS)] + [[9.0, 3.0]]
    monkeypatch.setattr(speed, "ours", lambda name, ratio: speed.Products(ratio))
    monkeypatch.setattr(speed, "other", lambda name, ratio, library: speed.Products(ratio))
    monkeypatch.setattr(speed, "block_length", lambda models: 10)
    left = iter(blocks)
    monkeypatch.setattr(speed, "turn", lambda models, steps, backwards: next(left))

    [row] = speed.worker("sac", 2, "sbx")["rows"]

    assert (row["low"], row["speed_up"], row["high"]) == (2.0, 2.0, 2.0)
    ours, theirs = np.median(blocks, 0)
    assert row["steps_per_s"] == pytest.approx(10 / ours)
    assert row["peer_steps_per_s"] == pytest.approx(10 / theirs)
    assert theirs / ours != 2.0


def test_one_measures_while_others_wait(monkeypatch, tmp_path):
    monkeypatch.setattr(runs, "CACHE", tmp_path)
    order: list[str] = []

    def another() -> None:
        with runs.others_waiting():
            order.append("another")

    with runs.others_waiting():
        waiting = threading.Thread(target=another)
        waiting.start()
        waiting.join(0.2)
        order.append("first")
    waiting.join(10.0)

    assert order == ["first", "another"]
