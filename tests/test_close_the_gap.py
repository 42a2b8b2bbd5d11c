"""The example that asks for the next recording runs to its end, and is right."""

import sys
from pathlib import Path

import pytest

sys.path[:0] = [str(Path(__file__).parent.parent / "examples")]

import close_the_gap  # noqa: E402


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
