"""The same diagnosis of many logs: each on its own, none twice, here or on a cluster."""

import json

import numpy as np
import pytest

from sb3_hds import Trajectories, cli
from sb3_hds.errors import StudyError
from sb3_hds.experiments.many_logs import diagnose_each

ARGUMENTS = ("--twin", "LinearAxis", "--effects", "viscous_friction", "--budget", "quick")


def standing(folder, *names):
    """Logs of an axis that does not move, which takes no search."""
    data = Trajectories.from_arrays([np.zeros((40, 2))] * 3, [np.zeros((39, 1))] * 3, dt=0.01)
    return [str(data.save(folder / name)) for name in names]


def ask(logs, folder, *more):
    return cli.main(["diagnose", *ARGUMENTS, "--data", *logs, "--each", str(folder), *more])


def test_every_log_is_diagnosed_once_and_failures_are_tried_again(tmp_path, capsys):
    logs, folder = standing(tmp_path, "monday", "tuesday"), tmp_path / "results"
    broken = tmp_path / "broken.npz"
    broken.write_bytes(b"no log")

    assert ask([*logs, str(broken)], folder) == 1
    said = capsys.readouterr().out
    assert "2 of 3 logs are diagnosed" in said and f"{broken}: " in said
    assert json.loads((folder / "monday.json").read_text())["verdict"] == "not_identifiable"
    table = (folder / "verdicts.csv").read_text().splitlines()
    assert table[0] == "log,verdict,causes,error"
    assert table[1] == f"{logs[0]},not_identifiable,," and table[3].startswith(f"{broken},,,")

    before = (folder / "monday.html").stat().st_mtime_ns
    (folder / "tuesday.html").unlink()  # as if interrupted before the page was written
    broken.write_bytes((tmp_path / "monday.npz").read_bytes())
    assert ask([*logs, str(broken)], folder) == 0
    said = capsys.readouterr().out
    assert "3 of 3 logs are diagnosed" in said and "monday.npz:" not in said
    assert (folder / "monday.html").stat().st_mtime_ns == before

    assert ask(logs, folder, "--seed", "1") == 1
    assert "diagnoses with other arguments" in capsys.readouterr().err


def test_logs_whose_results_would_have_one_name_are_refused(tmp_path):
    logs = [str(tmp_path / "log.npz"), str(tmp_path / "log.csv")]
    with pytest.raises(StudyError, match="differ in nothing but their suffix"):
        diagnose_each(logs, ARGUMENTS, tmp_path / "out")


def test_results_that_are_there_are_read(tmp_path):
    logs = ["runs/monday/log.csv", "runs/tuesday/log.csv"]
    for day, slot in (("monday", "joint"), ("tuesday", "parameter")):
        cause = {"effect": "parameter.mass", "where": {"slot": slot, "name": "axis"}}
        found = {"verdict": "named", "findings": [cause]}
        (tmp_path / f"runs_{day}_log.json").write_text(json.dumps(found))
        (tmp_path / f"runs_{day}_log.html").touch()

    found = diagnose_each(logs, ARGUMENTS, tmp_path)

    assert [one.causes for one in found] == [("parameter.mass.axis",), ("parameter.mass",)]
    assert [one.log for one in found] == logs


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (("--each", "out", "--json", "out.json"), "--json is about a single diagnosis"),
        (("--jobs", "2"), "name a folder with --each"),
    ],
)
def test_options_that_do_not_go_together_are_refused(more, says, tmp_path, capsys):
    (log,) = standing(tmp_path, "log")
    assert cli.main(["diagnose", *ARGUMENTS, "--data", log, *more]) == 1
    assert says in capsys.readouterr().err


@pytest.mark.expensive
def test_logs_are_diagnosed_on_a_cluster(cluster, tmp_path):
    logs = standing(tmp_path, "a", "b", "c", "d")
    found = diagnose_each(
        logs, ARGUMENTS, tmp_path / "out", memory=1.0, ray=cluster.address, tell=lambda _: None
    )
    assert [(one.log, one.verdict) for one in found] == [(x, "not_identifiable") for x in logs]
