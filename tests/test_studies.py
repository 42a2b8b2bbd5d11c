"""Examples that measure for long, or against the clock: whether they would, with few steps."""

import numpy as np
import pytest
import safe_swing_up
import ten_minutes

from sb3_hds import HDS


def against_the_end(missing: str) -> safe_swing_up.Protocol:
    """What is counted while the pivot is told to go to one end of the rail and back."""
    env, protocol = safe_swing_up.made(missing)
    env.reset(seed=0)
    for k in range(safe_swing_up.EPISODE):
        speed = safe_swing_up.SPEED if k % 100 < 50 else -safe_swing_up.SPEED
        *_, terminated, truncated, _ = env.step(np.array([speed], np.float32))
    assert (terminated, truncated) == ((True, False) if missing == "truncation" else (False, True))
    return protocol


def test_each_ingredient_of_the_safe_swing_up_changes_what_it_is_there_for():
    whole = against_the_end("")

    assert whole.steps == safe_swing_up.EPISODE and whole.hits == 0
    assert against_the_end("barrier").hits > 0
    # A command that jumps from one end to the other costs 1 for each jump.
    assert against_the_end("low-pass").changes > 1.5 * whole.changes
    against_the_end("truncation")


def test_the_safe_swing_up_writes_a_table_and_a_figure(tmp_path, monkeypatch):
    monkeypatch.setattr(safe_swing_up, "EPISODE", 10)

    safe_swing_up.main(["--steps", "24", "--without", "barrier", "--folder", str(tmp_path)])

    header, *rows = (tmp_path / "safe_swing_up.csv").read_text().splitlines()
    assert header == "without,seed,steps,return,violations,continuity"
    assert [row.split(",")[:3] for row in rows] == [["nothing", "0", "24"], ["barrier", "0", "24"]]
    assert (tmp_path / "safe_swing_up.png").is_file()


def test_an_error_of_the_learner_ends_the_run_beside_the_clock(monkeypatch, tmp_path):
    def broken(model, total_timesteps):
        raise FloatingPointError("The regression diverged.")

    monkeypatch.setattr(HDS, "learn", broken)
    with pytest.raises(FloatingPointError, match="diverged"):
        ten_minutes.main(["--minutes", "10", "--folder", str(tmp_path)])

    assert not list(tmp_path.iterdir())


@pytest.mark.expensive
def test_ten_minutes_run_against_the_clock_and_write_what_happened(tmp_path):
    ten_minutes.main(["--minutes", "0.4", "--folder", str(tmp_path)])

    header, *episodes = (tmp_path / "ten_minutes.csv").read_text().split()
    assert header == "minutes,steps,return,late"
    # An episode of 200 steps lasts ten seconds, longer where a step came late.
    minutes, steps, total, _ = map(float, episodes[0].split(","))
    assert steps == 200 and minutes >= 10.0 / 60.0
    assert -200 * (3.15**2 + 0.1 * 30.0**2) < total < 0.0
    assert (tmp_path / "ten_minutes.png").is_file()
