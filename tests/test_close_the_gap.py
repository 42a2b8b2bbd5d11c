"""The examples that ask for the next recording run to their end, and are right."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path[:0] = [str(Path(__file__).parent.parent / "examples")]

import close_the_gap  # noqa: E402
import ur10_next  # noqa: E402


@pytest.mark.expensive  # a diagnosis, a design, and five small trainings
def test_two_answers_become_one_and_it_is_what_was_hidden(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(close_the_gap, "EPOCHS", 1)
    monkeypatch.setattr(close_the_gap, "EPISODES", 1)
    monkeypatch.setattr(sys, "argv", ["close_the_gap.py", "--folder", str(tmp_path)])

    close_the_gap.main()

    said = capsys.readouterr().out
    before, after = said.split("Most of each limit")
    assert before.startswith("ambiguous") and "viscous_friction.hinge" in before
    assert "100.0%  quadratic_drag.hinge" in after
    assert [line.split()[0] for line in after.splitlines()[-6:-1]] == [
        *("as", "first", "belief", "decided", "truth")
    ]
    assert (tmp_path / "next.csv").exists()
    assert (tmp_path / "close_the_gap.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.expensive
@pytest.mark.measured
@pytest.mark.skipif("SB3_HDS_DATA" not in os.environ, reason="data outside the repository")
def test_joint_5_of_a_ur10_is_asked_within_its_limits():
    found, asked = ur10_next.asked_of_joint_5(Path(os.environ["SB3_HDS_DATA"], "ur10"))

    speeds, limits = asked.predicted[..., 1], ur10_next.LIMITS
    (offset,) = (f for f in found.findings if f.key == "constant_force.wrist_2_joint")
    told = offset.parameters["tau_0"]
    assert told.estimate == pytest.approx(-0.9, abs=0.2)  # 0.9 N m by its publishers' data
    (row,) = (a.factor["constant_force.wrist_2_joint.tau_0"] for a in found.answers.answers[:1])
    assert np.linalg.norm(row) == pytest.approx(told.stderr, rel=0.3)
    assert np.abs(asked.commands.actions).max() <= limits["torque"]
    assert np.abs(speeds).max() <= limits["velocity"]
