"""Examples and benchmarks that measure for long: whether they would, with few steps."""

import numpy as np
import pytest
import safe_swing_up

pytestmark = pytest.mark.usefixtures("quick_compilation")


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


def test_the_safe_swing_up_writes_a_table_and_a_figure(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(safe_swing_up, "EPISODE", 10)
    words = ["--steps", "24", "--without", "barrier", "--folder", str(tmp_path / "new")]

    safe_swing_up.main(words)

    header, *rows = (tmp_path / "new" / "safe_swing_up.csv").read_text().splitlines()
    assert header == "without,seed,steps,return,violations,continuity"
    assert [row.split(",")[:3] for row in rows] == [["nothing", "0", "24"], ["barrier", "0", "24"]]
    assert (tmp_path / "new" / "safe_swing_up.png").read_bytes().startswith(b"\x89PNG")
    assert "barrier" in capsys.readouterr().out.splitlines()[-1]
