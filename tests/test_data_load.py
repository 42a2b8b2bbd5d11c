"""Logs of any kind become trajectories, and what does not fit is refused at the door."""

import builtins
import glob
import json
import os
import re

import numpy as np
import pytest
import scipy.io

from sb3_hds import Trajectories
from sb3_hds.core import Trajectories as CoreTrajectories
from sb3_hds.core import trajectories
from sb3_hds.data import SamplingWarning
from sb3_hds.data.load import _paths
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


@pytest.mark.parametrize(("separator", "suffix"), [(";", "csv"), ("\t", "tsv"), (" ", "txt")])
def test_other_separators_are_recognised(separator, suffix, tmp_path):
    path = write_csv(tmp_path / f"log.{suffix}", swing(), separator)

    assert Trajectories.load(path, columns=COLUMNS).n_steps == 49


def test_spaces_and_a_number_sign_in_the_line_of_names_do_not_matter(tmp_path):
    (tmp_path / "log.csv").write_text("# t,  q, v , u\n0.0, 1, 2, 3\n0.1, 4, 5, 6\n")

    data = Trajectories.load(tmp_path / "log.csv", columns=COLUMNS)

    assert data.episode(0)[0].tolist() == [[1.0, 2.0], [4.0, 5.0]] and data.dt == 0.1


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
        "time: t\n"
        "obs: [{column: q, scale: 1e-1}, {column: v}]\n"
        "actions: [{column: u, scale: 2.0}]\n"
        "condition: {from: filename}\n"
    )

    data = Trajectories.load(str(tmp_path / "*.csv"), columns=str(tmp_path / "map.yml"))

    np.testing.assert_allclose(data.obs[0, :, 0], 0.1 * swing()["q"])
    assert data.conditions == ("log",) and data.actions[0, 3, 0] == 2.0 * swing()["u"][3]


def test_patterns_give_files_in_alphabetical_order_and_lists_keep_theirs(tmp_path, monkeypatch):
    found_anyhow = glob.glob
    monkeypatch.setattr(glob, "glob", lambda *a, **kw: sorted(found_anyhow(*a, **kw))[::-1])
    for name in ("b", "a", "c"):
        write_csv(tmp_path / f"{name}.csv", swing())
    columns = COLUMNS | {"condition": {"from": "filename"}}

    found = Trajectories.load(str(tmp_path / "*.csv"), columns=columns)
    listed = Trajectories.load([tmp_path / "c.csv", tmp_path / "a.csv"], columns=columns)

    assert found.conditions == ("a", "b", "c") and found.origin.tolist() == [0, 1, 2]
    assert listed.conditions == ("c", "a")


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


def test_without_a_column_of_time_rows_are_dt_apart(tmp_path):
    write_csv(tmp_path / "log.csv", swing())
    columns = {name: part for name, part in COLUMNS.items() if name != "time"}

    assert Trajectories.load(tmp_path / "log.csv", columns=columns | {"dt": 0.02}).dt == 0.02
    with pytest.raises(TrajectoryError, match="must name the column of time stamps, as time: NAME"):
        Trajectories.load(tmp_path / "log.csv", columns=columns)


def test_our_own_files_need_no_columns_and_come_back_together(tmp_path):
    write_csv(tmp_path / "log.csv", swing())
    data = Trajectories.load(tmp_path / "log.csv", columns=COLUMNS)
    for name in ("a", "b"):
        data.save(tmp_path / name)

    again = Trajectories.load(tmp_path / "a")
    both = Trajectories.load(str(tmp_path / "*.npz"))

    np.testing.assert_array_equal(again.obs, data.obs)
    assert again.report is None and len(both) == 2 and both.origin.tolist() == [0, 1]


def test_a_file_is_found_although_its_name_looks_like_a_pattern(tmp_path):
    path = write_csv(tmp_path / "run[1].csv", swing())

    assert Trajectories.load(str(path), columns=COLUMNS).n_steps == 49


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
    path = write_csv(tmp_path / "log.csv", table)

    with pytest.warns(SamplingWarning, match=r"log.csv was resampled to dt = 0.01 s: rows were"):
        data = Trajectories.load(path, columns=COLUMNS)

    grid = data.report.parts[0].begin + DT * np.arange(data.lengths[0] + 1)
    # Linear interpolation over h errs by at most h^2 / 8 times the second derivative, 9 and 27.
    bound = (1.2 * DT) ** 2 / 8.0
    np.testing.assert_allclose(data.obs[0, :, 0], np.sin(3.0 * grid), atol=9.0 * bound)
    np.testing.assert_allclose(data.obs[0, :, 1], 3.0 * np.cos(3.0 * grid), atol=27.0 * bound)
    [sampling] = data.report.recordings
    intervals = np.diff(table["t"])
    np.testing.assert_allclose(
        sampling.intervals, (intervals.min(), np.median(intervals), intervals.max())
    )
    # The grid is a mean of 400 stamps that are off by up to a tenth of an interval.
    assert sampling.resampled and 0.0 < sampling.moved <= 0.11 * DT
    assert sampling.clock == "jittered" and "were measured when the stamps say" in str(data.report)
    assert 0.0 < sampling.error[0] < 18.0 * bound


def test_a_resampled_command_gives_the_impulse_of_the_one_that_was_held(tmp_path):
    table = jittered(share=0.6)
    path = write_csv(tmp_path / "log.csv", table)

    with pytest.warns(SamplingWarning):
        data = Trajectories.load(path, columns=COLUMNS | {"dt": 3.0 * DT})

    span = data.lengths[0] * data.dt
    held = np.minimum(table["t"][1:], span) - np.minimum(table["t"][:-1], span)
    assert data.actions.sum() * data.dt == pytest.approx(held @ table["u"][:-1], rel=1e-9)


def test_stamps_within_a_hundredth_of_an_interval_leave_rows_as_they_are(tmp_path):
    table = swing()
    table["t"] = table["t"] + 0.005 * DT * np.random.default_rng(0).uniform(-1.0, 1.0, 50)

    data = Trajectories.load(write_csv(tmp_path / "log.csv", table), columns=COLUMNS)

    np.testing.assert_array_equal(data.obs[0, :, 0], table["q"])
    assert data.dt == DT


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

    assert data.lengths.tolist() == [19, 29] and data.origin.tolist() == [0, 0]
    assert data.report.recordings[0].gaps == ((20, pytest.approx(0.07)),)
    with pytest.warns(SamplingWarning, match="6 missing rows were filled in by interpolation"):
        whole = Trajectories.load(path, columns=COLUMNS | {"gap": 1.0})
    assert whole.lengths.tolist() == [55]
    np.testing.assert_array_equal(whole.obs[0, 26:, 0], table["q"][20:])
    np.testing.assert_array_equal(whole.actions[0, 18:27, 0], [1.8, *[1.9] * 7, 2.0])


def test_a_row_with_the_stamp_of_the_one_before_is_left_out_and_counted(tmp_path):
    table = {name: np.insert(column, 10, column[9]) for name, column in swing().items()}
    path = write_csv(tmp_path / "log.csv", table)

    with pytest.warns(SamplingWarning, match="1 row with the stamp of the row before was left out"):
        data = Trajectories.load(path, columns=COLUMNS)

    np.testing.assert_array_equal(data.obs[0, :, 0], swing()["q"])
    assert data.report.recordings[0].repeated == (10,)


def test_the_report_prints_in_80_columns_and_goes_with_selections_but_not_through_jax(tmp_path):
    import jax

    path = write_csv(tmp_path / ("a" * 60 + ".csv"), jittered())
    with pytest.warns(SamplingWarning):
        data = Trajectories.load(path, columns=COLUMNS)

    assert max(map(len, str(data.report).splitlines())) <= 80
    assert json.loads(json.dumps(data.report.to_dict()))["recordings"][0]["rows"] == 400
    assert data[:1].report is data.windows(20).report is data.report
    assert jax.tree.map(lambda leaf: leaf, data).report is None


# --- refused at the door


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"observations": ["q"]},
            "has the key 'observations', which is not known. Known are: obs,",
        ),
        ({"action": ["u"]}, "Did you mean 'actions'?"),
        ({"obs": "q"}, "obs must be a list of columns, got 'q'."),
        ({"obs": []}, "obs must name at least one column."),
        ({"obs": [{"colum": "q"}]}, "obs[0] has the key 'colum', which is not known."),
        ({"obs": [{"scale": 2.0}]}, "obs[0] needs either 'column'"),
        ({"obs": [{"column": "q", "constant": 1.0}]}, "obs[0] needs either 'column'"),
        ({"obs": [{"column": "q", "scale": "big"}]}, "scale must be a finite number, got 'big'"),
        ({"obs": [True]}, "must be the name of a column, got True. Names that yml takes for"),
        ({"obs": ["q", "q"]}, "two channels of obs are called 'q'. Give one another name"),
        ({"time": {"constant": 0.0}}, "time needs either 'column'"),
        ({"condition": "load"}, "condition must be {column: NAME} or {from: filename}, got 'load'"),
        ({"condition": {"from": "folder"}}, "condition must be {column: NAME} or {from: filename}"),
        ({"dt": -1.0}, "dt must be the sampling interval in seconds, finite and positive"),
        ({"obs": None}, "columns does not say which are the obs."),
        ({"obs": ["angle"]}, "'log.csv' has no column 'angle'. It has: t, q, v, u."),
        ({"obs": ["Q"]}, "'log.csv' has no column 'Q'. It has: t, q, v, u."),
    ],
)
def test_columns_that_make_no_sense_are_refused_with_the_way_out(change, message, tmp_path):
    write_csv(tmp_path / "log.csv", swing())

    with pytest.raises(TrajectoryError, match=re.escape(message)):
        Trajectories.load(tmp_path / "log.csv", columns=COLUMNS | change)


def test_a_yml_file_that_cannot_be_read_says_why(tmp_path):
    write_csv(tmp_path / "log.csv", swing())
    contents = {
        "broken": ("obs: [q", "is not valid yml"),
        "list": ("- q\n- v", "holds a list. columns names what a log holds"),
        "key": ("tiem: t", "has the key 'tiem', which is not known.*Did you mean 'time'"),
        "object": ("obs: !!python/object/apply:os.getcwd []", "is not valid yml"),
    }

    for name, (text, message) in contents.items():
        (tmp_path / f"{name}.yml").write_text(text)
        with pytest.raises(TrajectoryError, match=message):
            Trajectories.load(tmp_path / "log.csv", columns=tmp_path / f"{name}.yml")
    with pytest.raises(TrajectoryError, match="could not be read: No such file"):
        Trajectories.load(tmp_path / "log.csv", columns="nowhere.yml")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda t: t["q"].__setitem__(3, np.nan),
            "Column 'q' of 'log.csv' must be finite, got nan in",
        ),
        (
            lambda t: t["t"].__setitem__(3, np.inf),
            "Column 't' of 'log.csv' must be finite, got inf in",
        ),
        (
            lambda t: t["u"].__setitem__(7, np.nan),
            "got nan in row 7, counted from 0 (1 such values",
        ),
        (
            lambda t: t["t"].__setitem__(slice(20, None), t["t"][20:] - 0.15),
            "Time decreases in 'log.csv', from 0.19 to 0.05 s at row 20, counted from 0. If a new "
            "episode begins there, name the column that tells: episode: {column: NAME}.",
        ),
    ],
)
def test_a_defect_is_named_with_column_and_row(change, message, tmp_path):
    table = swing()
    change(table)

    with pytest.raises(TrajectoryError, match=re.escape(message)):
        Trajectories.load(write_csv(tmp_path / "log.csv", table), columns=COLUMNS)


def test_the_action_of_the_last_row_acts_on_nothing_and_may_be_missing(tmp_path):
    table = swing()
    table["u"][-1] = np.nan

    assert Trajectories.load(write_csv(tmp_path / "log.csv", table), columns=COLUMNS).n_steps == 49


def test_text_where_numbers_are_expected_is_quoted(tmp_path):
    (tmp_path / "log.csv").write_text("t,q,v,u\n0.0,1,2,3\n0.1,none,5,6\n")
    (tmp_path / "bad.csv").write_text("t,q,v,u\n0.0,1,2,3\n0.1,off?,5,6\n")

    with pytest.raises(TrajectoryError, match=r"must hold numbers, got 'off\?' in row 1"):
        Trajectories.load(tmp_path / "bad.csv", columns=COLUMNS)


def test_files_with_different_columns_are_refused_with_the_difference(tmp_path):
    write_csv(tmp_path / "a.csv", swing())
    write_csv(
        tmp_path / "b.csv", {k: v for k, v in swing().items() if k != "v"} | {"w": swing()["v"]}
    )

    with pytest.raises(
        TrajectoryError, match=r"a.csv' has 'v', .*b.csv' has not; it has: t, q, u, w"
    ):
        Trajectories.load(str(tmp_path / "*.csv"), columns=COLUMNS)


def test_columns_of_different_length_are_refused(tmp_path):
    np.savez(tmp_path / "log.npz", **(swing() | {"v": np.zeros(49)}))

    with pytest.raises(
        TrajectoryError, match="must have the same length, got q 50, t 50, u 50, v 49"
    ):
        Trajectories.load(tmp_path / "log.npz", columns=COLUMNS)


def test_files_that_cannot_be_read_say_why(tmp_path):
    (tmp_path / "log.json").write_text('{"t": [0.0,')
    (tmp_path / "text.json").write_text('"hello"')
    (tmp_path / "log.mat").write_bytes(b"nothing that MATLAB wrote" * 20)
    (tmp_path / "log.npz").write_bytes(b"PK nothing")
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "numbers.csv").write_text("0.0,1,2,3\n0.1,1,2,3\n")
    (tmp_path / "log.xls").write_text("")
    (tmp_path / "picture.csv").write_bytes(bytes(range(256)))
    expected = {
        "log.json": "is damaged or not a .json file",
        "text.json": "has no column 'q', 't', 'u', 'v'. It has: 0.",
        "log.mat": "is damaged or not a .mat file",
        "log.npz": "is damaged",
        "empty.csv": "is empty: nothing was logged",
        "numbers.csv": "begins with numbers, so that its 4 columns have no names: write their numb",
        "log.xls": "there are readers for .csv, .tsv, .txt, .dat, .log, .parquet, .npz, .npy",
        "picture.csv": "is damaged or not a .csv file",
        "nowhere.csv": "does not exist",
        "": "is a folder; name the files in it",
    }

    for name, message in expected.items():
        with pytest.raises(TrajectoryError, match=re.escape(message)):
            Trajectories.load(tmp_path / name, columns=COLUMNS)
    with pytest.raises(TrajectoryError, match=r"No file matches '.*\*.hdf'"):
        Trajectories.load(str(tmp_path / "*.hdf"), columns=COLUMNS)
    with pytest.raises(TrajectoryError, match="cannot be read without columns"):
        Trajectories.load([tmp_path / "log.json"])
    with pytest.raises(TrajectoryError, match="names no file"):
        Trajectories.load([], columns=COLUMNS)


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_that_is_cut_anywhere_is_refused_or_read_up_to_there(name, tmp_path):
    path = WRITERS[name](tmp_path / name, swing(200))
    content = path.read_bytes()

    for share in np.linspace(0.0, 0.99, 25):
        path.write_bytes(content[: int(share * len(content))])
        try:
            data = Trajectories.load(path, columns=COLUMNS)
        except TrajectoryError:
            continue
        assert path.suffix in (".csv", ".mat") and data.n_steps < 200


def test_nothing_is_unpickled(tmp_path):
    class Evil:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "owned"),))

    np.savez(tmp_path / "log.npz", t=np.array([Evil()], dtype=object))

    for columns in (COLUMNS, None):
        with pytest.raises(TrajectoryError, match=r"holds Python objects.* have to be unpickled"):
            Trajectories.load(tmp_path / "log.npz", columns=columns)
    assert not (tmp_path / "owned").exists()


def test_what_is_missing_for_parquet_and_minari_is_named(tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name.split(".")[0] in ("pyarrow", "fastparquet", "minari"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    (tmp_path / "log.parquet").write_bytes(b"PAR1")
    monkeypatch.setattr(builtins, "__import__", without)
    monkeypatch.setattr("importlib.import_module", without)

    with pytest.raises(TrajectoryError, match=r"pip install sb3-hds\[parquet\]"):
        Trajectories.load(tmp_path / "log.parquet", columns=COLUMNS)
    with pytest.raises(TrajectoryError, match=r"pip install sb3-hds\[minari\]"):
        Trajectories.load("minari:any/set-v0", columns={"dt": 0.05})


def test_core_alone_reads_our_own_files_and_says_who_reads_logs(tmp_path, monkeypatch):
    monkeypatch.setattr(trajectories, "_log_reader", None)
    assert CoreTrajectories is Trajectories

    with pytest.raises(TrajectoryError, match="from sb3_hds import Trajectories"):
        CoreTrajectories.load(tmp_path / "log.csv", columns=COLUMNS)


def test_a_data_set_of_minari_is_read(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    import gymnasium

    env = minari.DataCollector(gymnasium.make("Pendulum-v1", max_episode_steps=20))
    seen = []
    for episode in range(3):
        rows = [env.reset(seed=episode)[0]]
        for _ in range(20):
            rows.append(env.step(env.action_space.sample())[0])
        seen.append(np.array(rows))
    env.create_dataset("test/pendulum-v0")

    data = Trajectories.load("minari:test/pendulum-v0", columns={"dt": 0.05})
    speed = Trajectories.load(
        "minari:test/pendulum-v0", columns={"dt": 0.05, "obs": ["observations[2]"]}
    )

    np.testing.assert_array_equal(data.obs, np.array(seen))
    assert data.lengths.tolist() == [20] * 3 and data.n_act == 1
    np.testing.assert_array_equal(speed.obs[..., 0], data.obs[..., 2])
    with pytest.raises(TrajectoryError, match="dt: SECONDS"):
        Trajectories.load("minari:test/pendulum-v0")
    with pytest.raises(TrajectoryError, match="no data set 'nobody/nothing-v0' on this machine"):
        Trajectories.load("minari:nobody/nothing-v0", columns={"dt": 0.05})


def test_a_sign_before_the_names_is_no_column(tmp_path):
    t = 0.01 * np.arange(50)
    path = tmp_path / "log.txt"
    np.savetxt(path, np.c_[t, np.sin(t), np.cos(t), 0.5 + 0.0 * t], header="t q v u")

    data = Trajectories.load(path, columns={"time": "t", "obs": ["q", "v"], "actions": ["u"]})

    np.testing.assert_allclose(data.obs[0], np.c_[np.sin(t), np.cos(t)], atol=1e-7)
    np.testing.assert_allclose(data.actions[0], 0.5)


def test_decimal_commas_between_commas_are_refused(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,q,u\n" + "".join(f"0,0{i},1,5,0,0\n" for i in range(1, 9)))

    with pytest.raises(TrajectoryError, match="3 names in its first line and 6 fields"):
        Trajectories.load(path, columns={"time": "t", "obs": ["q"], "actions": ["u"]})


def test_a_log_without_rows_says_so(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,q,u\n")

    with pytest.raises(TrajectoryError, match="no row"):
        Trajectories.load(path, columns={"time": "t", "obs": ["q"], "actions": ["u"]})


def test_numbers_of_a_vector_in_a_record_are_named_one_by_one(tmp_path):
    path = tmp_path / "log.json"
    path.write_text(json.dumps([{"t": 0.1 * i, "obs": [i, -i], "u": 0} for i in range(9)]))
    columns = {"time": "t", "actions": ["u"]}

    data = Trajectories.load(path, columns=columns | {"obs": ["obs[1]", "obs[0]"]})

    np.testing.assert_array_equal(data.obs[0], np.outer(np.arange(9), [-1, 1]))
    with pytest.raises(TrajectoryError, match=r"in each row. Name them one by one: obs\[0\], obs"):
        Trajectories.load(path, columns=columns | {"obs": ["obs"]})


@pytest.mark.parametrize("kind", ["datetime64[ns]", "timedelta64[us]"])
def test_dates_and_durations_count_seconds(kind):
    from sb3_hds.data.columns import columns_from
    from sb3_hds.data.rows import rows_of

    stamps = (np.arange(5) * 10_000_000).astype("timedelta64[ns]")
    stamps = np.datetime64("2026-01-01T00:00:00", "ns") + stamps if "date" in kind else stamps
    table = {"t": stamps.astype(kind), "q": np.arange(5.0), "u": np.zeros(5)}

    [rows] = rows_of(
        table, columns_from({"time": "t", "obs": ["q"], "actions": ["u"]}), "log", "log"
    )

    np.testing.assert_allclose(rows.times, 0.01 * np.arange(5), atol=1e-12)


def test_stamps_in_milliseconds_are_not_filled_up(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,q,u\n" + "".join(f"{10 * i},{i},0\n" for i in range(50)))
    columns = {"time": "t", "obs": ["q"], "actions": ["u"], "dt": 0.01}

    with pytest.raises(TrajectoryError, match=r"nothing is known of 1000 steps.*scale: 0.001"):
        Trajectories.load(path, columns=columns)


@pytest.mark.parametrize("files", [None, 3])
def test_what_names_no_file_is_refused(files):
    with pytest.raises(TrajectoryError, match=f"files must be paths or patterns, got {files}"):
        _paths(files)  # types are checked before, where tests run


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("logged by rig 3\nt,q,u\n0.0,1.0,0.0\n0.1,1.1,0.0\n", "before the names: skip: 1."),
        ("rig,3,hot\nMonday\nt,q,u\n0.0,1.0,0.0\n0.1,1.1,0.0\n", "before the names: skip: 2."),
        ("t,q,u\nlow,high,low\n0.0,1.0,0.0\n0.1,1.1,0.0\n", "what follows must be numbers, got"),
        ("t,q,u\n0,1,2\n3,4,5,6\n", "has 4 fields in line 3 and 3 before. Correct"),
        ("t,q,u\n2024-05-01 12:00:00.1,1,0\n2024-05-01 12:00:00.2,1,0\n", "to seconds before"),
        ("t,q,u\n12:00:00.1,1.0,0.0\n12:00:00.2,1.1,0.0\n", "Convert dates and times of day"),
    ],
)
def test_lines_that_do_not_belong_into_a_log_are_told_apart(text, says, tmp_path):
    (tmp_path / "log.csv").write_text(text)

    with pytest.raises(TrajectoryError) as refusal:
        Trajectories.load(tmp_path / "log.csv", {"time": "t", "obs": ["q"], "actions": ["u"]})

    assert says in str(refusal.value)


def test_an_archive_that_is_none_is_refused_without_a_word_of_pickles(tmp_path):
    (tmp_path / "log.npz").write_bytes(b"nothing of the kind")

    with pytest.raises(TrajectoryError, match="it holds no arrays of numbers"):
        Trajectories.load(tmp_path / "log.npz")


def test_a_recording_is_no_evidence_twice(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,q,u\n" + "".join(f"{0.1 * i},{i},0\n" for i in range(50)))

    with pytest.raises(TrajectoryError, match="2 times: a recording is evidence only once"):
        Trajectories.load(
            [path, str(tmp_path / "*.csv")],
            columns={"time": "t", "obs": ["q"], "actions": ["u"]},
        )


@pytest.mark.parametrize("lowest", [-np.pi, 0.0])
def test_angles_that_wrap_are_not_interpolated_unless_they_are_named(tmp_path, lowest):
    rng = np.random.default_rng(0)
    times = 0.01 * np.arange(600) + 0.003 * rng.random(600)
    turning = 5.0 * times + 0.01 * rng.standard_normal(600)
    table = {"t": times, "q": (turning - lowest) % (2.0 * np.pi) + lowest, "u": 0.0 * times}
    path, columns = write_csv(tmp_path / "log.csv", table), {"time": "t", "actions": ["u"]}

    with pytest.raises(TrajectoryError, match=r"jumps by a whole turn after row .*angle: true"):
        Trajectories.load(path, columns=columns | {"obs": ["q"]})
    with pytest.warns(SamplingWarning):
        data = Trajectories.load(path, columns=columns | {"obs": [{"column": "q", "angle": True}]})
    assert data.n_steps > 500
