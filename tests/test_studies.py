"""Examples and benchmarks that measure for long: whether they would, with few steps."""

import action_scale
import numpy as np
import pytest
import runs
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


def test_runs_of_another_length_are_no_part_of_the_picture_of_scales(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(action_scale, "RESULTS", tmp_path)
    monkeypatch.setattr(runs, "RESULTS", tmp_path)
    lines = ["scale,seed,steps,timestep,distance,finished"]
    for steps, distance in ((60, 110.0), (90, 1000.0)):
        for seed in range(2):
            lines += [f"0.4,{seed},{steps},{k},{distance + seed},1" for k in (30, 60)]
    (tmp_path / "action_scale.csv").write_text("\n".join(lines) + "\n")

    action_scale.report(60)

    said = capsys.readouterr().out.split()
    assert said.count("110.5") == 2 and "1000.5" not in said
    kept = (tmp_path / "action_scale_reached.csv").read_text()
    assert kept.splitlines() == [
        "scale,seeds,steps to 100 m,distance at the end [m]",
        "0.4,2,30,110 +- 1",
    ]
    assert (tmp_path / "action_scale.png").read_bytes().startswith(b"\x89PNG")
    action_scale.report(6_000)
    assert "has no runs of 6000 steps" in capsys.readouterr().out


def test_an_oval_is_driven_round_by_steering_into_its_bends():
    env = action_scale.Oval()
    env.reset(seed=0)
    covered = 0.0
    for _ in range(200):
        place, offset, heading, _ = env.state
        wheel = np.arctan(action_scale.curvature(place + 0.5)) - 0.5 * heading - 0.2 * offset
        _, reward, off, cut, _ = env.step(np.array([wheel / 0.5, -0.6]))
        covered += reward
        assert not off
    # 20 s at 4 m/s, after having braked from 7 m/s.
    assert cut and covered == pytest.approx(80.0, rel=0.1)
