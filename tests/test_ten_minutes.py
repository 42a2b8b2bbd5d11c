"""The example that learns beside a control loop: it runs, and a learner that fails ends it."""

import pytest
import ten_minutes

from sb3_hds import HDS


def test_an_error_of_the_learner_ends_the_run(monkeypatch, tmp_path):
    def broken(model, total_timesteps):
        raise FloatingPointError("The regression diverged.")

    monkeypatch.setattr(HDS, "learn", broken)
    with pytest.raises(FloatingPointError, match="diverged"):
        ten_minutes.main(["--minutes", "10", "--folder", str(tmp_path)])

    assert not list(tmp_path.iterdir())


@pytest.mark.expensive
def test_the_example_runs_against_the_clock_and_writes_what_happened(tmp_path):
    ten_minutes.main(["--minutes", "0.4", "--folder", str(tmp_path)])

    header, *episodes = (tmp_path / "ten_minutes.csv").read_text().split()
    assert header == "minutes,steps,return,late"
    # An episode of 200 steps lasts ten seconds, longer where a step came late.
    minutes, steps, total, _ = map(float, episodes[0].split(","))
    assert steps == 200 and minutes >= 10.0 / 60.0
    assert -200 * (3.15**2 + 0.1 * 30.0**2) < total < 0.0
    assert (tmp_path / "ten_minutes.png").stat().st_size > 0
