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

from sb3_hds import Trajectories
from sb3_hds.core import Trajectories as CoreTrajectories
from sb3_hds.core import trajectories
from sb3_hds.data import SamplingWarning
from sb3_hds.data.columns import columns_from
from sb3_hds.data.load import _paths
from sb3_hds.data.rows import rows_of
from sb3_hds.errors import TrajectoryError

DT = 0.01
COLUMNS = {"time": "t", "obs": ["q", "v"], "actions": ["u"]}

pytestmark = pytest.mark.filterwarnings("error::sb3_hds.data.SamplingWarning")


def swing(n=50, dt=DT, start=0.0):
    """Columns of a log: a sine, its derivative, and a command that counts."""
    t = start + dt * np.arange(n)
    return {"t": t, "q": np.sin(3.0 * t), "v": 3.0 * np.cos(3.0 * t), "u": np.arange(n) / 10.0}


def write_csv(path, table, separator=","):
    rows = zip(*table.values(), strict=True)
    lines = [separator.join(table), *(separator.join(str(x) for x in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_npz(path, table):
    np.savez(path, **table)
    return path


def write_parquet(path, table):
    pandas, _ = pytest.importorskip("pandas"), pytest.importorskip("pyarrow")
    pandas.DataFrame(table).to_parquet(path)
    return path


def write_mat(path, table):
    scipy.io.savemat(path, table)
    return path


def write_json(path, table):
    path.write_text(json.dumps({name: list(map(float, c)) for name, c in table.items()}))
    return path


def write_records(path, table):
    rows = [
        dict(zip(table, map(float, row), strict=True)) for row in zip(*table.values(), strict=True)
    ]
    path.write_text(json.dumps({"mass": 0.5, "entries": rows}))
    return path


WRITERS = {
    "log.csv": write_csv,
    "log.npz": write_npz,
    "log.parquet": write_parquet,
    "log.mat": write_mat,
    "log.json": write_json,
    "records.json": write_records,
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_log_of_any_format_holds_observation_k_and_the_action_that_follows_it(name, tmp_path):
    table = swing()

    data = Trajectories.load(WRITERS[name](tmp_path / name, table), columns=COLUMNS)

    obs, actions = data.episode(0)
    np.testing.assert_array_equal(obs, np.stack([table["q"], table["v"]], axis=1))
    np.testing.assert_array_equal(actions, table["u"][:-1, None])
    assert (data.dt, data.conditions, not data.report.altered) == (DT, ("default",), True)


def test_columns_are_scaled_shifted_held_constant_and_renamed(tmp_path):
    write_csv(tmp_path / "log.csv", swing())
    columns = {
        "time": {"column": "t", "scale": 2.0},
        "obs": [
            {"column": "q", "scale": -2.0, "offset": 1.0, "name": "angle"},
            {"constant": 7.0, "name": "load"},
        ],
        "actions": [],
    }

    data = Trajectories.load(tmp_path / "log.csv", columns=columns)

    np.testing.assert_allclose(data.obs[0, :, 0], 1.0 - 2.0 * swing()["q"], rtol=1e-15)
    assert (data.obs[0, :, 1] == 7.0).all() and data.n_act == 0
    assert data.dt == 2.0 * DT and data.report.obs == ("angle", "load")


def test_a_yml_file_says_the_same_as_a_dict(tmp_path):
    write_csv(tmp_path / "log.csv", swing())
    (tmp_path / "map.yml").write_text(
        "dt: 0.02\nobs: [{column: q, scale: 1e-1}, {column: v}]\n"
        "actions: [{column: u, scale: 2.0}]\ncondition: {from: filename}\n"
    )

    data = Trajectories.load(str(tmp_path / "*.csv"), columns=str(tmp_path / "map.yml"))

    np.testing.assert_allclose(data.obs[0, :, 0], 0.1 * swing()["q"])
    assert data.conditions == ("log",) and data.actions[0, 3, 0] == 2.0 * swing()["u"][3]
    assert data.dt == 0.02


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
    with pytest.raises(TrajectoryError, match="a recording is evidence only once"):
        Trajectories.load([tmp_path / "a.csv", str(tmp_path / "*.csv")], columns=COLUMNS)


def test_episodes_are_told_apart_by_a_column_and_by_another_condition(tmp_path):
    one, two = swing(20), swing(30)
    table = {name: np.concatenate([one[name], two[name], two[name]]) for name in one}
    table |= {
        "run": np.repeat([0, 1, 1], [20, 30, 30]),
        "load": np.repeat([0.5, 1, 2], [20, 30, 30]),
    }
    table["t"][50:] += 1.0
    write_csv(tmp_path / "log.csv", table)
    columns = COLUMNS | {"episode": "run", "condition": {"column": "load"}}

    data = Trajectories.load(tmp_path / "log.csv", columns=columns)

    assert data.lengths.tolist() == [19, 29, 29]
    assert data.conditions == ("0.5", "1", "2")
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
    write_csv(tmp_path / "log.csv", swing())
    data = Trajectories.load(tmp_path / "log.csv", columns=COLUMNS)
    for name in ("a", "b"):
        data.save(tmp_path / name)

    again = Trajectories.load(tmp_path / "a")
    both = Trajectories.load(str(tmp_path / "*.npz"))

    np.testing.assert_array_equal(again.obs, data.obs)
    assert again.report is None and len(both) == 2 and both.origin.tolist() == [0, 1]


# --- time


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
    steps = np.diff(table["t"])
    np.testing.assert_allclose(sampling.intervals, (steps.min(), np.median(steps), steps.max()))
    # The grid is a mean of 400 stamps that are off by up to a tenth of an interval.
    assert sampling.resampled and 0.0 < sampling.moved <= 0.11 * DT
    assert sampling.clock == "jittered" and 0.0 < sampling.error[0] < 18.0 * bound
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


def test_an_angle_turns_the_shorter_way_when_resampled(tmp_path):
    table = swing(40, dt=0.1)
    table["q"] = (0.4 * np.arange(40) + np.pi) % (2.0 * np.pi) - np.pi
    columns = {"time": "t", "obs": [{"column": "q", "angle": True}], "actions": ["u"], "dt": 0.05}

    with pytest.warns(SamplingWarning):
        data = Trajectories.load(write_csv(tmp_path / "log.csv", table), columns=columns)

    angle = data.obs[0, :, 0]
    assert (angle >= -np.pi).all() and (angle < np.pi).all()
    np.testing.assert_allclose(np.unwrap(angle), 0.2 * np.arange(79), atol=1e-12)


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


# --- refused at the door


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"observations": ["q"]}, "the key 'observations', which is not known"),
        ({"action": ["u"]}, "Did you mean 'actions'?"),
        ({"obs": "q"}, "obs must be a list of columns, got 'q'."),
        ({"obs": []}, "obs must name at least one column."),
        ({"obs": [{"colum": "q"}]}, "obs[0] has the key 'colum'"),
        ({"obs": [{"column": "q", "constant": 1.0}]}, "obs[0] needs either 'column'"),
        ({"obs": [{"column": "q", "scale": "big"}]}, "scale must be a finite number, got 'big'"),
        ({"obs": [True]}, "must be the name of a column, got True"),
        ({"obs": ["q", "q"]}, "two channels of obs are called 'q'"),
        ({"time": {"constant": 0.0}}, "time needs either 'column'"),
        ({"time": None}, "time: NAME"),
        ({"condition": "load"}, "condition must be {column: NAME} or {from: filename}"),
        ({"dt": -1.0}, "dt must be the sampling interval"),
        ({"obs": None}, "columns does not say which are the obs."),
        ({"obs": ["Q"]}, "'log.csv' has no column 'Q'. It has: t, q, v, u."),
        # Its stamps are milliseconds, of which a thousand fit into this dt.
        ({"time": {"column": "t", "scale": 1e3}, "dt": 0.01}, "scale: 0.001"),
    ],
)
def test_columns_that_make_no_sense_are_refused_with_the_way_out(change, message, tmp_path):
    write_csv(tmp_path / "log.csv", swing())

    with pytest.raises(TrajectoryError, match=re.escape(message)):
        Trajectories.load(tmp_path / "log.csv", columns=COLUMNS | change)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("obs: [q", "is not valid yml"),
        ("- q\n- v", "holds a list. columns names what a log holds"),
        ("tiem: t", "has the key 'tiem', which is not known.*Did you mean 'time'"),
        ("obs: !!python/object/apply:os.getcwd []", "is not valid yml"),
        (None, "could not be read"),
    ],
)
def test_a_yml_file_that_cannot_be_read_says_why(text, message, tmp_path):
    write_csv(tmp_path / "log.csv", swing())
    if text is not None:
        (tmp_path / "map.yml").write_text(text)

    with pytest.raises(TrajectoryError, match=message):
        Trajectories.load(tmp_path / "log.csv", columns=tmp_path / "map.yml")


@pytest.mark.parametrize(
    ("column", "rows", "value", "message"),
    [
        ("q", slice(3, 4), np.nan, "Column 'q' of 'log.csv' must be finite, got nan in"),
        ("t", slice(3, 4), np.inf, "Column 't' of 'log.csv' must be finite, got inf in"),
        ("u", slice(7, 8), np.nan, "got nan in row 7, counted from 0 (1 such values"),
        ("t", slice(20, 50), 0.05, "decreases in 'log.csv', from 0.19 to 0.05 s at row 20"),
        ("u", slice(49, 50), np.nan, None),  # the last action acts on nothing
    ],
)
def test_a_defect_is_named_with_column_and_row(column, rows, value, message, tmp_path):
    table = swing()
    table[column][rows] = value
    path = write_csv(tmp_path / "log.csv", table)

    if message is None:
        assert Trajectories.load(path, columns=COLUMNS).n_steps == 49
        return
    with pytest.raises(TrajectoryError, match=re.escape(message)):
        Trajectories.load(path, columns=COLUMNS)


def test_files_that_cannot_be_read_say_why(tmp_path):
    write_csv(tmp_path / "a.csv", swing())
    write_csv(tmp_path / "b.csv", {k: v for k, v in swing().items() if k != "v"})
    np.savez(tmp_path / "log.npz", **(swing() | {"v": np.zeros(49)}))
    contents = {
        "log.json": (b'{"t": [0.0,', "is damaged or not a .json file"),
        "text.json": (b'"hello"', "has no column 'q', 't', 'u', 'v'. It has: 0."),
        "log.mat": (b"nothing that MATLAB wrote" * 20, "is damaged or not a .mat file"),
        "bad.npz": (b"PK nothing", "is damaged"),
        "empty.csv": (b"", "is empty: nothing was logged"),
        "names.csv": (b"t,q,v,u\n", "no row"),
        "numbers.csv": (b"0.0,1,2,3\n0.1,1,2,3\n", "its 4 columns have no names: write their numb"),
        "log.xls": (b"", "there are readers for .csv, .tsv"),
        "picture.csv": (bytes(range(256)), "is damaged or not a .csv file"),
        "nowhere.csv": (None, "does not exist"),
        "log.npz": (None, "must have the same length, got q 50, t 50, u 50, v 49"),
        "": (None, "is a folder; name the files in it"),
        "[ab].csv": (None, "b.csv' has not; it has: t, q, u"),
        "*.hdf": (None, "No file matches"),
    }

    for name, (content, message) in contents.items():
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(TrajectoryError, match=re.escape(message)):
            Trajectories.load(str(tmp_path / name), columns=COLUMNS)
    with pytest.raises(TrajectoryError, match="cannot be read without columns"):
        Trajectories.load([tmp_path / "log.json"])
    with pytest.raises(TrajectoryError, match="names no file"):
        Trajectories.load([], columns=COLUMNS)
    with pytest.raises(TrajectoryError, match="files must be paths or patterns, got 3"):
        _paths(3)  # types are checked before, where tests run


def test_nothing_is_unpickled(tmp_path):
    class Evil:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "owned"),))

    np.savez(tmp_path / "log.npz", t=np.array([Evil()], dtype=object))

    for columns in (COLUMNS, None):
        with pytest.raises(TrajectoryError, match=r"holds Python objects.* have to be unpickled"):
            Trajectories.load(tmp_path / "log.npz", columns=columns)
    assert not (tmp_path / "owned").exists()


def test_core_alone_reads_our_own_files_and_says_who_reads_logs(tmp_path, monkeypatch):
    monkeypatch.setattr(trajectories, "_log_reader", None)
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


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("logged by rig 3\nt,q,u\n0.0,1.0,0.0\n0.1,1.1,0.0\n", "before the names: skip: 1."),
        ("rig,3,hot\nMonday\nt,q,u\n0.0,1.0,0.0\n0.1,1.1,0.0\n", "before the names: skip: 2."),
        ("t,q,u\nlow,high,low\n0.0,1.0,0.0\n0.1,1.1,0.0\n", "what follows must be numbers, got"),
        ("t,q,u\n0,1,2\n3,4,5,6\n", "has 4 fields in line 3 and 3 before"),
        ("t,q,u\n0,00,1,5,0,0\n0,01,1,5,0,0\n", "3 names in its first line and 6 fields"),
        ("t,q,u\n0.0,1,3\n0.1,off?,6\n", "must hold numbers, got 'off?' in row 1"),
        ("t,q,u\n2024-05-01 12:00:00.1,1,0\n2024-05-01 12:00:00.2,1,0\n", "to seconds before"),
        ("t,q,u\n12:00:00.1,1.0,0.0\n12:00:00.2,1.1,0.0\n", "Convert dates and times of day"),
    ],
)
def test_lines_that_do_not_belong_into_a_log_are_told_apart(text, says, tmp_path):
    (tmp_path / "log.csv").write_text(text)

    with pytest.raises(TrajectoryError, match=re.escape(says)):
        Trajectories.load(tmp_path / "log.csv", COLUMNS | {"obs": ["q"]})


def test_angles_that_wrap_are_not_interpolated_unless_they_are_named(tmp_path):
    rng = np.random.default_rng(0)
    times = 0.01 * np.arange(600) + 0.003 * rng.random(600)
    turning = 5.0 * times + 0.01 * rng.standard_normal(600)
    table = {"t": times, "q": turning % (2.0 * np.pi), "u": 0.0 * times}
    path = write_csv(tmp_path / "log.csv", table)

    with pytest.raises(TrajectoryError, match=r"jumps by a whole turn after row .*angle: true"):
        Trajectories.load(path, columns=COLUMNS | {"obs": ["q"]})
    with pytest.warns(SamplingWarning):
        data = Trajectories.load(path, columns=COLUMNS | {"obs": [{"column": "q", "angle": True}]})
    assert data.n_steps > 500
