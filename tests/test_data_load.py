"""Logs of any kind become trajectories, and what does not fit is refused at the door."""

import glob
import json
import os
import re

import gymnasium
import jax
import numpy as np
import pytest
import scipy.io
import yaml
from cases import each

from sb3_hds import Trajectories
from sb3_hds.core import Trajectories as CoreTrajectories
from sb3_hds.core.trajectories import trajectories
from sb3_hds.data import SamplingWarning
from sb3_hds.data.columns import columns_from
from sb3_hds.data.resampling.rows import rows_of
from sb3_hds.errors import TrajectoryError

DT = 0.01
COLUMNS = {"time": "t", "obs": ["q", "v"], "actions": ["u"]}

pytestmark = pytest.mark.filterwarnings("error::sb3_hds.data.SamplingWarning")


def swing(n=50, dt=DT, start=0.0):
    """Columns of a log: a sine, its derivative, and a command that counts."""
    t = start + dt * np.arange(n)
    return {"t": t, "q": np.sin(3.0 * t), "v": 3.0 * np.cos(3.0 * t), "u": np.arange(n) / 10.0}


def write_csv(path, table):
    rows = zip(*table.values(), strict=True)
    lines = [",".join(table), *(",".join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("kind", ["dict", "yml"])
def test_columns_are_scaled_shifted_held_constant_and_renamed(kind, tmp_path):
    write_csv(tmp_path / "log.csv", swing())
    columns = {
        "time": {"column": "t", "scale": 2.0},
        "obs": [
            {"column": "q", "scale": -2.0, "offset": 1.0, "name": "angle"},
            {"constant": 7.0, "name": "load"},
        ],
        "actions": [],
        "condition": {"from": "filename"},
    }
    if kind == "yml":
        # What YAML takes for a word is a number, too.
        (tmp_path / "map.yml").write_text(yaml.safe_dump(columns).replace("2.0", "2e0"))
        columns = str(tmp_path / "map.yml")

    data = Trajectories.load(str(tmp_path / "*.csv"), columns=columns)

    np.testing.assert_allclose(data.obs[0, :, 0], 1.0 - 2.0 * swing()["q"], rtol=1e-15)
    assert (data.obs[0, :, 1] == 7.0).all() and data.n_act == 0
    assert data.dt == 2.0 * DT and data.report.obs == ("angle", "load")
    assert data.conditions == ("log",)


def test_patterns_give_files_in_alphabetical_order_and_lists_keep_theirs(tmp_path, monkeypatch):
    found_anyhow = glob.glob
    monkeypatch.setattr(glob, "glob", lambda *a, **kw: sorted(found_anyhow(*a, **kw))[::-1])
    for name in ("b", "a", "run[1]"):
        write_csv(tmp_path / f"{name}.csv", swing())
    columns = COLUMNS | {"condition": {"from": "filename"}}

    found = Trajectories.load(str(tmp_path / "*.csv"), columns=columns)
    # Although its name looks like a pattern.
    listed = Trajectories.load([str(tmp_path / "run[1].csv"), tmp_path / "a.csv"], columns=columns)

    assert found.conditions == ("a", "b", "run[1]") and found.origin.tolist() == [0, 1, 2]
    assert listed.conditions == ("run[1]", "a")
    with pytest.raises(TrajectoryError, match="use each recording once"):
        Trajectories.load([tmp_path / "a.csv", str(tmp_path / "*.csv")], columns=COLUMNS)


def test_a_column_or_a_new_condition_separates_episodes(tmp_path):
    one, two = swing(20), swing(30)
    table = {name: np.concatenate([one[name], two[name], two[name]]) for name in one}
    run, load = (np.repeat(labels, [20, 30, 30]) for labels in ([0, 1, 1], [0.5, 1, 2]))
    table |= {"run": run, "load": load}
    table["t"][50:] += 1.0
    write_csv(tmp_path / "log.csv", table)
    columns = COLUMNS | {"episode": "run", "condition": {"column": "load"}}

    data = Trajectories.load(tmp_path / "log.csv", columns=columns)

    assert data.lengths.tolist() == [19, 29, 29] and data.conditions == ("0.5", "1", "2")
    assert data.origin.tolist() == [0, 1, 2]


def test_cells_of_a_mat_file_are_episodes_and_the_longer_axis_of_a_matrix_is_time(tmp_path):
    one, two = swing(20), swing(30)
    cells = {name: np.empty(2, object) for name in ("T", "Y", "U")}
    for i, part in enumerate((one, two)):
        cells["T"][i] = part["t"]
        cells["Y"][i] = np.stack([part["q"], part["v"]])
        cells["U"][i] = part["u"][:, None]
    scipy.io.savemat(tmp_path / "log.mat", cells | {"mass": 0.3, "rig": {"name": "arm"}})
    columns = {"time": "T", "obs": ["Y[1]", "Y[0]", "mass"], "actions": ["U"]}
    columns["condition"] = {"column": "rig.name"}

    data = Trajectories.load(tmp_path / "log.mat", columns=columns)

    assert data.lengths.tolist() == [19, 29] and data.conditions == ("arm", "arm")
    np.testing.assert_array_equal(data.episode(1)[0][:, 0], two["v"])
    assert (data.obs[..., 2] == 0.3).all()


def test_our_own_files_need_no_columns_and_come_back_together(tmp_path):
    table = swing()
    table["u"][-1] = np.nan  # it acts on nothing
    data = Trajectories.load(write_csv(tmp_path / "log.csv", table), columns=COLUMNS)
    for name in ("a", "b"):
        data.save(tmp_path / name)

    again = Trajectories.load(tmp_path / "a")
    both = Trajectories.load(str(tmp_path / "*.npz"))

    np.testing.assert_array_equal(again.obs, data.obs)
    assert again.report is None and len(both) == 2 and both.origin.tolist() == [0, 1]


def jittered(n=400, share=0.2, seed=0):
    """Rows of a smooth motion whose stamps are off by up to a share of the interval."""
    rng = np.random.default_rng(seed)
    table = swing(n)
    t = table["t"] + share * DT * rng.uniform(-0.5, 0.5, n)
    t[0] = 0.0
    return {"t": t, "q": np.sin(3.0 * t), "v": 3.0 * np.cos(3.0 * t), "u": np.sin(t)}


def test_jittered_stamps_are_resampled_and_the_change_is_reported(tmp_path):
    table = jittered()
    path = write_csv(tmp_path / ("a" * 60 + ".csv"), table)

    with pytest.warns(SamplingWarning, match=r"was resampled to dt = 0.01 s"):
        data = Trajectories.load(path, columns=COLUMNS)

    grid = data.report.parts[0].begin + DT * np.arange(data.lengths[0] + 1)
    # Linear interpolation over h errs by at most h^2 / 8 times the second derivative, 9 and 27.
    bound = (1.2 * DT) ** 2 / 8.0
    np.testing.assert_allclose(data.obs[0, :, 0], np.sin(3.0 * grid), atol=9.0 * bound)
    np.testing.assert_allclose(data.obs[0, :, 1], 3.0 * np.cos(3.0 * grid), atol=27.0 * bound)
    [sampling] = data.report.recordings
    # The grid is a mean of 400 stamps that are off by up to a tenth of an interval.
    assert sampling.clock == "jittered" and 0.0 < sampling.moved <= 0.11 * DT
    assert "measured at their stamps" in data.report.clocks() and data.report.altered
    assert 0.0 < sampling.error[0] < 18.0 * bound
    assert max(map(len, str(data.report).splitlines())) <= 80
    assert json.loads(json.dumps(data.report.to_dict()))["recordings"][0]["rows"] == 400
    # It goes with selections, but not through JAX.
    assert data[:1].report is data.windows(20).report is data.report
    assert jax.tree.map(lambda leaf: leaf, data).report is None


def test_a_resampled_command_gives_the_impulse_of_the_one_that_was_held(tmp_path):
    table = jittered(share=0.6)
    path = write_csv(tmp_path / "log.csv", table)

    with pytest.warns(SamplingWarning):
        data = Trajectories.load(path, columns=COLUMNS | {"dt": 3.0 * DT})

    span = data.lengths[0] * data.dt
    held = np.minimum(table["t"][1:], span) - np.minimum(table["t"][:-1], span)
    assert data.actions.sum() * data.dt == pytest.approx(held @ table["u"][:-1], rel=1e-9)


def test_a_gap_ends_the_episode_and_both_parts_are_one_recording(tmp_path):
    table = swing(50)
    table["t"][20:] += 6.0 * DT
    path = write_csv(tmp_path / "log.csv", table)

    with pytest.warns(SamplingWarning, match=r"log.csv was cut at 1 gap of up to 0.07 s"):
        data = Trajectories.load(path, columns=COLUMNS)
    with pytest.warns(SamplingWarning, match="6 missing rows were filled in"):
        whole = Trajectories.load(path, columns=COLUMNS | {"gap": 1.0})

    assert data.lengths.tolist() == [19, 29] and data.origin.tolist() == [0, 0]
    assert data.report.recordings[0].gaps == ((20, pytest.approx(0.07)),)
    np.testing.assert_array_equal(whole.obs[0, 26:, 0], table["q"][20:])
    np.testing.assert_array_equal(whole.actions[0, 18:27, 0], [1.8, *[1.9] * 7, 2.0])


@each(
    ({"tiem": "t"}, "Did you mean 'time'"),
    ({"obs": "q"}, "obs must be a list of columns, got 'q'."),
    ({"obs": [{"colum": "q"}]}, "obs[0] has the unknown key 'colum'"),
    ({"obs": [{"column": "q", "constant": 1.0}]}, "obs[0] needs either 'column'"),
    ({"obs": [{"column": "q", "scale": "big"}]}, "scale must be a finite number, got 'big'"),
    ({"obs": ["q", "q"]}, "obs: two channels are called 'q'"),
    ({"time": None}, "time: NAME"),
    ({"condition": "load"}, "condition must be {column: NAME} or {from: filename}"),
    ({"obs": None}, "columns does not name the obs."),
    ({"obs": ["Q"]}, "'log.csv' has no column 'Q'. It has: t, q, v, u."),
    # Its stamps are milliseconds, of which a thousand fit into this dt.
    ({"time": {"column": "t", "scale": 1e3}, "dt": 0.01}, "scale: 0.001"),
)
def test_columns_that_make_no_sense_are_refused_with_the_way_out(change, message, tmp_path):
    write_csv(tmp_path / "log.csv", swing())
    with pytest.raises(TrajectoryError, match=re.escape(message)):
        Trajectories.load(tmp_path / "log.csv", columns=COLUMNS | change)


def test_a_yml_file_runs_no_code(tmp_path):
    for text in ("obs: [q", "obs: !!python/object/apply:os.getcwd []"):
        (tmp_path / "map.yml").write_text(text)
        with pytest.raises(TrajectoryError, match="is not valid yml"):
            Trajectories.load(tmp_path / "log.csv", columns=tmp_path / "map.yml")


LINES = "0.0,1,2,3\n0.1,1,2,3\n"


@each(
    ("text.json", '"hello"', "has no column 'q', 't', 'u', 'v'. It has: 0."),
    ("log.mat", "nothing that MATLAB wrote" * 20, "is damaged or not a .mat file"),
    ("log.csv", "", "is empty: nothing was logged"),
    ("log.csv", LINES, "its 4 columns have no names: use their numb"),
    ("log.csv", "rig,3,hot\nMonday\nt,q,v,u\n" + LINES, "before the names: skip: 2."),
    ("log.csv", "t,q,v,u\nlow,high,low,low\n" + LINES, "followed by numbers, got"),
    ("log.csv", "t,q,v,u\n0,1,2,3\n3,4,5,6,7\n", "has 5 fields in line 3 and 4 before"),
    ("log.csv", "t,q,v,u\n0,00,1,5,0,0,0,0\n", "4 names in its first line and 8 fields"),
    ("log.csv", f"t,q,v,u\n{LINES}0.2,off?,6,0\n", "must hold numbers, got 'off?' in row 2"),
    ("log.csv", "t,q,v,u\n2024-05-01 12:00:00.1,1,0,0\n", "to seconds first"),
    ("log.csv", f"t,q,v,u\n{LINES}0.2,nan,6,0\n", "must be finite, got nan in row 2"),
    ("log.csv", f"t,q,v,u\n{LINES}0.05,0,6,0\n", "from 0.1 to 0.05 s at row 2"),
    ("log.csv", b"\x89HDF\r\n\x1a\n" + bytes(99), "looks like an HDF5 file, in spite of its name"),
    ("log.mat", b"PAR1" + bytes(99), "rename it to 'log.parquet'"),
    ("log.db3", b"nothing", "'ros2 bag reindex' or 'rosbag reindex'"),
    ("log.csv", bytes(range(256)), "is damaged or not a .csv file"),
    ("nowhere.csv", None, "does not exist"),
    ("log.npz", None, "must have the same length, got q 50, t 50, u 50, v 49"),
    ("", None, "is a folder; name the files in it"),
    ("[ab].csv", None, "b.csv' does not; it has: t, q, u"),
    ("*.hdf", None, "No file matches"),
)
def test_a_file_that_cannot_be_read_says_why(name, content, says, tmp_path):
    write_csv(tmp_path / "a.csv", swing())
    write_csv(tmp_path / "b.csv", {k: v for k, v in swing().items() if k != "v"})
    np.savez(tmp_path / "log.npz", **(swing() | {"v": np.zeros(49)}))
    if content is not None:
        content = content.encode() if isinstance(content, str) else content
        (tmp_path / name).write_bytes(content)

    with pytest.raises(TrajectoryError, match=re.escape(says)):
        Trajectories.load(str(tmp_path / name), columns=COLUMNS)


def test_nothing_is_unpickled(tmp_path):
    class Evil:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "owned"),))

    np.savez(tmp_path / "log.npz", t=np.array([Evil()], dtype=object))

    for columns in (COLUMNS, None):
        with pytest.raises(TrajectoryError, match=r"holds Python objects.* have to be unpickled"):
            Trajectories.load(tmp_path / "log.npz", columns=columns)
    assert not (tmp_path / "owned").exists()


def test_saved_trajectories_and_logs_are_not_mixed(tmp_path):
    saved = Trajectories.from_arrays([np.zeros((4, 1))], [np.zeros((3, 1))], dt=DT)
    files = [saved.save(tmp_path / "saved.npz"), write_csv(tmp_path / "log.csv", swing())]
    with pytest.raises(TrajectoryError, match=r"was written by Trajectories\.save and cannot be"):
        Trajectories.load(files)


def test_core_alone_reads_our_own_files_and_says_who_reads_logs(tmp_path, monkeypatch):
    monkeypatch.setattr(trajectories, "log_reader", lambda: None)
    assert CoreTrajectories is Trajectories
    with pytest.raises(TrajectoryError, match="from sb3_hds import Trajectories"):
        CoreTrajectories.load(tmp_path / "log.csv", columns=COLUMNS)


def test_a_data_set_of_minari_is_read(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    env = minari.DataCollector(gymnasium.make("Pendulum-v1", max_episode_steps=20))
    seen = []
    for episode in range(3):
        rows = [env.reset(seed=episode)[0]]
        rows += [env.step(env.action_space.sample())[0] for _ in range(20)]
        seen.append(np.array(rows))
    env.create_dataset("test/pendulum-v0")
    name = "minari:test/pendulum-v0"

    data = Trajectories.load(name, columns={"dt": 0.05})
    speed = Trajectories.load(name, columns={"dt": 0.05, "obs": ["observations[2]"]})

    np.testing.assert_array_equal(data.obs, np.array(seen))
    assert data.lengths.tolist() == [20] * 3 and data.n_act == 1
    np.testing.assert_array_equal(speed.obs[..., 0], data.obs[..., 2])
    with pytest.raises(TrajectoryError, match="dt: SECONDS"):
        Trajectories.load(name)
    with pytest.raises(TrajectoryError, match="no data set 'nobody/nothing-v0'"):
        Trajectories.load("minari:nobody/nothing-v0", columns={"dt": 0.05})


@pytest.mark.parametrize("kind", ["datetime64[ns]", "timedelta64[us]"])
def test_dates_and_durations_count_seconds(kind):
    stamps = (np.arange(5) * 10_000_000).astype("timedelta64[ns]")
    stamps = np.datetime64("2026-01-01T00:00:00", "ns") + stamps if "date" in kind else stamps
    table = {"t": stamps.astype(kind), "q": np.arange(5.0), "v": np.zeros(5), "u": np.zeros(5)}

    [rows] = rows_of(table, columns_from(COLUMNS), "log", "log")

    np.testing.assert_allclose(rows.times, 0.01 * np.arange(5), atol=1e-12)
