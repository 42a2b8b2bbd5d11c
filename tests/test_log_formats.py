"""Files as people have them: layouts, units, nesting, bags; and damaged ones."""

import json
import os
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import yaml

from sb3_hds import Trajectories, audit, cli, twins
from sb3_hds.data import Recorder
from sb3_hds.data.columns import columns_from
from sb3_hds.data.conversion import same_quantity, unit_of
from sb3_hds.errors import CalibrationError, TrajectoryError
from sb3_hds.sysid import calibrate, diagnose

COLUMNS = {"time": "t", "obs": ["q"], "actions": ["u"]}
N = 30
T = 0.01 * np.arange(N)
TABLE = {"t": T, "q": np.sin(3.0 * T), "v": 3.0 * np.cos(3.0 * T), "u": np.arange(N) / 10.0}

h5py = pytest.importorskip("h5py", reason="needs the extra 'hdf5'")
rosbags = pytest.importorskip("rosbags", reason="needs the extra 'ros'")
pandas = pytest.importorskip("pandas")
pytest.importorskip("pyarrow", reason="needs the extra 'parquet'")


def load(path, columns=None, content=None):
    if content is not None:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    return Trajectories.load(path, columns=columns)


def text(table=TABLE, separator=",", names=True):
    lines = [separator.join(f"{x:.6g}" for x in row) for row in zip(*table.values(), strict=True)]
    return "\n".join([separator.join(table)] * names + lines) + "\n"


# --- layouts of text


ROWS = [("0.00", "0.1", "0"), ("0.01", "0.2", "0"), ("0.02", "0.3", "0")]


def lay(head, separator=",", decimal=".", end="", rows=ROWS):
    """The rows under the lines of the head."""
    lines = [separator.join(row).replace(".", decimal) + end for row in rows]
    return "\n".join([head, *lines][head == "" :]) + "\n"


BY_NUMBER = {"time": 0, "obs": [1], "actions": [2]}
STAMPED = {"time": ["sec", {"column": "nanosec", "unit": "ns"}]}
MILLI = [("0", "100", "0"), ("10", "200", "0"), ("20", "300", "0")]
NANO = [(f"16000000000{t}0000000", x, u) for t, (_, x, u) in enumerate(ROWS)]
SPLIT = [("7", "990000000", "0.1", "0"), ("8", "0", "0.2", "0"), ("8", "10000000", "0.3", "0")]


@pytest.mark.parametrize(
    ("content", "columns"),
    [
        (lay("t;q;u", ";", ","), {}),
        (lay("t\tq\tu", "\t", ","), {}),
        (lay("t q u", " ", ","), {}),
        (lay("t;q;u;", ";", end=";"), {}),
        (lay("t,\tq,\tu", ",\t"), {}),
        (lay("t q u\n[s] [rad] [Nm]", " "), {}),
        (lay("t,q,u\ns,rad,1"), {}),
        (lay("t,q,u\n(ms),(mrad),(-)", rows=MILLI), {}),
        (lay("# rig 3, Monday\n# Tuesday\nt,q,u"), {}),
        (lay("% t q u", " "), {}),
        (lay("# t,  q , u"), {}),
        (lay("sep=;\nt;q;u", ";"), {}),
        (lay("rig 3\n\nt,q,u"), {"skip": 1}),
        (lay(""), BY_NUMBER),
        (lay("# rig 3", ";", ","), BY_NUMBER),
        (lay("0,1,2"), BY_NUMBER),
        (lay("%time,q,u", rows=NANO), {"time": "%time"}),
        (lay("sec,nanosec,q,u", rows=SPLIT), STAMPED),
        (lay("t [ms];a [mrad];u", ";", rows=MILLI), {"time": "t [ms]", "obs": ["a [mrad]"]}),
    ],
)
def test_a_table_of_text_is_read_in_any_layout(content, columns, tmp_path):
    data = load(tmp_path / "log.csv", COLUMNS | columns, content)

    np.testing.assert_allclose(data.obs[0, :, 0], [0.1, 0.2, 0.3], rtol=1e-12)
    assert data.lengths.tolist() == [2] and data.dt == pytest.approx(0.01, rel=1e-9)
    assert (data.actions == 0.0).all()


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "cp1252"])
def test_a_sign_of_degrees_is_read_in_any_encoding(encoding, tmp_path):
    content = "t,q,u\ns,\N{DEGREE SIGN},N\n0,180,0\n1,-90,0\n".encode(encoding)

    data = load(tmp_path / "log.csv", COLUMNS, content)

    np.testing.assert_allclose(data.obs[0, :, 0], [np.pi, -np.pi / 2.0])
    assert data.report.units == ("rad",) and data.report.action_units == ("N",)


def test_decimal_commas_that_come_late_are_seen(tmp_path):
    lines = [f"{i};0;0" for i in range(100)] + [f"{i};{i},5;0" for i in range(100, 200)]

    data = load(tmp_path / "log.csv", COLUMNS, "t;q;u\n" + "\n".join(lines))

    assert data.obs[0, 150, 0] == 150.5


@pytest.mark.parametrize(("unit", "start"), [("s", 1.7e9), ("ms", 1.7e12)])
def test_dates_of_this_century_are_told_by_their_size(unit, start, tmp_path):
    stamps = [int(start) + round(k / unit_of(unit).factor) for k in range(3)]

    data = load(
        tmp_path / "log.csv", COLUMNS, lay("t,q,u", rows=[(f"{t}", "0", "0") for t in stamps])
    )

    assert data.dt == 1.0
    assert data.report.notes == ((f"t counts {unit} since 1970.",) if unit != "s" else ())


def test_nanoseconds_since_1970_are_not_rounded(tmp_path):
    rows = [(f"{1_700_000_000_000_000_000 + 10_000 * k}", "0", "0") for k in range(9)]

    data = load(tmp_path / "log.csv", COLUMNS, lay("t,q,u", rows=rows))

    # Doubles of that size are 256 ns apart.
    assert data.dt == pytest.approx(1e-5, rel=1e-9) and not data.report.altered


# --- units


@pytest.mark.parametrize(
    ("unit", "value", "si", "name"),
    [
        ("deg", 180.0, np.pi, "rad"),
        ("turns", 0.5, np.pi, "rad"),
        ("rpm", 60.0, 2.0 * np.pi, "rad/s"),
        ("deg/s", 360.0, 2.0 * np.pi, "rad/s"),
        ("ms", 1500.0, 1.5, "s"),
        ("mm", 20.0, 0.02, "m"),
        ("g", 300.0, 0.3, "kg"),
        ("N mm", 5.0, 0.005, "N m"),
        ("kgf cm", 1.0, 0.0980665, "N m"),
        ("kN", 2.0, 2000.0, "N"),
        ("mA", 20.0, 0.02, "A"),
        ("degC", 21.0, 21.0, "degC"),
        ("m/s^2", 3.0, 3.0, "m/s2"),
        ("g0", 1.0, 9.80665, "m/s2"),
        ("%", 50.0, 0.5, "1"),
        ("N\N{MIDDLE DOT}m\N{MIDDLE DOT}s/rad", 2.0, 2.0, "N m s/rad"),
    ],
)
def test_a_column_is_converted_from_its_unit(unit, value, si, name, tmp_path):
    content = text({"t": T, "q": value + 0.0 * T, "u": value + 0.0 * T})
    entries = {"obs": [{"column": "q", "unit": unit, "offset": 1.0}]}
    entries |= {"actions": [{"column": "u", "unit": unit}]}

    data = load(tmp_path / "log.csv", COLUMNS | entries, content)

    np.testing.assert_allclose(data.obs, si + 1.0, rtol=1e-12)
    np.testing.assert_allclose(data.actions, si, rtol=1e-12)
    assert (data.report.units, data.report.action_units) == ((name,), (name,))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"obs": [{"column": "q", "unit": "furlong"}]}, "'furlong' is not known. Known are rad"),
        ({"obs": [{"column": "q", "unit": "W/m2 K"}]}, "is not known"),
        ({"obs": [{"column": "q", "unit": "counts"}]}, "mean nothing without a scale"),
        ({"obs": [{"column": "q", "unit": "mm", "angle": True}]}, "an angle is in rad, deg or"),
        ({"time": {"column": "t", "unit": "deg"}}, "time is in one of s, ms, us"),
    ],
)
def test_a_unit_that_cannot_be_converted_is_refused(change, says):
    with pytest.raises(TrajectoryError, match=says):
        columns_from(COLUMNS | change)


def test_time_has_a_unit_and_counts_have_a_scale(tmp_path):
    content = text({"t": 1000.0 * T, "q": np.arange(N), "u": T})
    columns = {"time": {"column": "t", "unit": "ms"}, "actions": ["u"]}
    columns["obs"] = [{"column": "q", "unit": "ticks", "scale": 0.5}]

    data = load(tmp_path / "log.csv", columns, content)

    assert data.dt == 0.01 and data.obs[0, 3, 0] == 1.5 and data.report.units == ("",)


def test_a_scale_counts_more_than_the_unit_that_a_file_names(tmp_path):
    content = "t,q,u\ns,deg,N\n0,1,0\n1,2,0\n"
    scaled = COLUMNS | {"obs": [{"column": "q", "scale": 10.0}]}

    assert load(tmp_path / "log.csv", scaled, content).obs[0, :, 0].tolist() == [10.0, 20.0]
    named = load(tmp_path / "log.csv", COLUMNS)
    assert "q in deg" in str(named.report) and named.report.units == ("rad",)


def test_files_that_name_different_units_are_told_apart(tmp_path):
    (tmp_path / "a.csv").write_text("t,q,u\ns,deg,N\n0,1,0\n1,2,0\n")
    (tmp_path / "b.csv").write_text("t,q,u\n0,1,0\n1,2,0\n")

    with pytest.raises(TrajectoryError, match=r"'q' is in deg in .*obs: \[{column: q, unit: UNIT}"):
        load(str(tmp_path / "*.csv"), COLUMNS)


def test_units_measure_the_same_or_not():
    assert same_quantity("N m", "kg m2/s2") and same_quantity("deg", "rad")
    assert same_quantity("1/s", "rad/s") is False and same_quantity("m", "rad") is False
    assert same_quantity("", "rad") is None and same_quantity("command unit", "N") is None


def test_a_channel_in_the_unit_of_something_else_is_refused_with_the_line_to_write(tmp_path):
    content = text({"t": T, "angle": TABLE["q"], "speed": TABLE["v"], "u": TABLE["u"]})
    columns = COLUMNS | {"obs": [{"column": "angle", "unit": "mm"}, "speed"], "actions": []}
    twin = twins.FreePendulum(dt=0.01)
    data = load(tmp_path / "log.csv", columns, content)
    line = r"'angle' was read in m, and .* is in rad.*obs: \[{column: angle, unit: rad}\]"

    for question in (diagnose, calibrate):
        with pytest.raises(CalibrationError, match=line):
            question(twin, data)
    with pytest.raises(TrajectoryError, match=line):
        audit(data, channels=twin.channels)
    assert audit(data).channels[0].unit == "m"


# --- nesting


EPISODES = [{"t": [0.0, 0.1, 0.2], "q": [0, 1, 2], "u": [0] * 3}, {"t": [0.0, 0.1], "q": [0, 1]}]
EPISODES[1]["u"] = [0, 0]
RECORDS = [
    [dict(zip(e, row, strict=True)) for row in zip(*e.values(), strict=True)] for e in EPISODES
]


ALL_ROWS = [{"run": i} | row for i, rows in enumerate(RECORDS) for row in rows]


@pytest.mark.parametrize(
    ("content", "more"),
    [
        (EPISODES, {}),
        ({"config": {"hz": 10}, "data": EPISODES}, {}),
        ({"data": EPISODES, "old": EPISODES[:1]}, {"records": "data"}),
        ({"a": {"b": EPISODES}, "c": [{"x": 1}]}, {"records": "a.b"}),
        ({"run_2": EPISODES[0], "run_10": EPISODES[1]}, {}),
        ({"data": {"wide": EPISODES[0], "xs": EPISODES[1]}}, {"records": "data"}),
        ([{"load": 3, "steps": rows} for rows in RECORDS], {}),
        ({key: [episode[key] for episode in EPISODES] for key in "tqu"}, {}),
        (ALL_ROWS, {"episode": "run"}),
    ],
)
def test_episodes_are_found_wherever_json_nests_them(content, more, tmp_path):
    data = load(tmp_path / "log.json", COLUMNS | more, json.dumps(content))

    assert data.lengths.tolist() == [2, 1] and data.dt == 0.1
    assert data.obs[0, :, 0].tolist() == [0.0, 1.0, 2.0]
    with pytest.raises(TrajectoryError, match="on the way to records"):
        load(tmp_path / "log.json", COLUMNS | {"records": "data.x.y"})


KEYED = {"t": {str(k): 0.1 * k for k in range(5)}, "q": {str(k): k for k in range(5)}, "u": 0}


@pytest.mark.parametrize(
    ("content", "columns"),
    [
        ([{"t": 0.1 * k, "q": k, "u": 0} for k in range(5)], {}),
        ([{"t": 0.1 * k, "s": {"q": [9, k]}, "u": 0} for k in range(5)], {"obs": ["s.q[1]"]}),
        (KEYED, {}),
        ([[0.1 * k, k, 0] for k in range(5)], BY_NUMBER),
    ],
)
def test_rows_are_read_from_any_json(content, columns, tmp_path):
    data = load(tmp_path / "log.json", COLUMNS | columns, json.dumps(content))

    assert data.lengths.tolist() == [4] and data.obs[0, :, 0].tolist() == [0, 1, 2, 3, 4]


def test_lines_of_json_are_rows_and_a_line_that_was_cut_is_left_out(tmp_path):
    lines = "".join(json.dumps({"t": 0.1 * k, "q": k, "u": 0}) + "\n" for k in range(5))

    assert load(tmp_path / "log.jsonl", COLUMNS, lines[:-9]).lengths.tolist() == [3]
    with pytest.raises(TrajectoryError, match=r"cannot be read without columns.*sb3-hds columns"):
        load(tmp_path / "log.jsonl")
    assert load(tmp_path / "log.json", COLUMNS, lines).lengths.tolist() == [4]
    pretty = json.dumps([json.loads(line) for line in lines.splitlines()], indent=1)
    assert load(tmp_path / "pretty.jsonl", COLUMNS, pretty).lengths.tolist() == [4]
    with pytest.raises(TrajectoryError, match="line 2: "):
        load(tmp_path / "bad.jsonl", COLUMNS, lines.replace('{"t": 0.1,', "{t: 0.1,", 1))


def test_a_list_in_each_row_of_parquet_is_columns_and_episode_index_tells_recordings(tmp_path):
    state = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    frame = {"observation.state": list(state), "action": list(state[:, :1])}
    frame |= {"timestamp": np.tile(np.arange(25) / 30, 2), "episode_index": np.repeat([3, 4], 25)}
    pandas.DataFrame(frame).to_parquet(tmp_path / "log.parquet")
    columns = {"time": "timestamp", "actions": ["action[0]"]}

    data = load(tmp_path / "log.parquet", columns | {"obs": ["observation.state[3]"]})

    np.testing.assert_array_equal(data.obs[:, :, 0], state[:, 3].reshape(2, 25))
    np.testing.assert_array_equal(data.actions[0, :, 0], state[:24, 0])
    assert data.dt == pytest.approx(1 / 30) and data.origin.tolist() == [0, 1]
    with pytest.raises(TrajectoryError, match=r"one by one: observation.state\[0\], observation"):
        load(tmp_path / "log.parquet", columns | {"obs": ["observation.state"]})


@pytest.mark.parametrize(
    ("groups", "more"),
    [("data/demo_{}", {}), ("data/demo_{}", {"records": "data"}), ("{}", {}), ("set/x{}", None)],
)
def test_groups_of_hdf5_are_episodes(groups, more, tmp_path):
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for i, n in ((2, 10), (10, 7)):
            group = file.create_group(groups.format(i))
            group["obs/q"] = np.arange(n + 1.0)[:, None] * [1.0, 10.0]
            group["act"] = np.ones((n, 1))
        file["names"] = ["a", "b"]
    columns = {"dt": 0.1, "obs": ["obs/q[1]"], "actions": ["act[0]"]}

    data = load(tmp_path / "log.h5", columns | ({"records": "set"} if more is None else more))

    assert data.lengths.tolist() == [10, 7] and data.obs[0, 3, 0] == 30.0


def test_the_first_of_three_axes_counts_episodes(tmp_path):
    obs = np.random.default_rng(0).normal(size=(3, 11, 2))
    np.savez(tmp_path / "log.npz", x=obs, u=np.zeros((3, 10, 1)), load=np.array(["a", "b", "b"]))
    columns = {"dt": 0.1, "obs": ["x[0]", "x[1]"], "actions": ["u[0]"]}

    data = load(tmp_path / "log.npz", columns | {"condition": {"column": "load"}})

    np.testing.assert_array_equal(data.obs, obs)
    assert data.conditions == ("a", "b", "b") and data.lengths.tolist() == [10] * 3


def test_fields_and_single_arrays_of_numpy_are_read(tmp_path):
    rows = np.array(list(zip(*TABLE.values(), strict=True)), [(name, float) for name in TABLE])
    np.savez(tmp_path / "log.npz", run=rows, note="hello")
    np.save(tmp_path / "log.npy", np.stack(list(TABLE.values()), axis=1))
    by_name = {"time": "run.t", "obs": ["run.q"], "actions": ["run.u"]}

    first = load(tmp_path / "log.npz", by_name)
    second = load(tmp_path / "log.npy", {"time": 0, "obs": [1], "actions": [3]})

    np.testing.assert_array_equal(first.obs, second.obs)
    assert first.obs[0, 5, 0] == TABLE["q"][5]


def mat_of_version_7_3(path):
    """As MATLAB writes it: transposed, behind a block of text, cells as references."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, column in TABLE.items():
            file[name] = column[None]
            file[f"run/{name}"] = column[None]
        file["text"] = np.array([[ord(c)] for c in "arm"], np.uint16)
        file["text"].attrs["MATLAB_class"] = np.bytes_("char")
        file["none"] = np.zeros(2, np.uint64)
        file["none"].attrs["MATLAB_empty"] = 1
        for name in ("t", "q", "u"):
            cells = [
                file.create_dataset(f"#refs#/{name}{i}", data=TABLE[name][None, :m])
                for i, m in enumerate((20, 10))
            ]
            file.create_dataset(f"c{name}", data=[[c.ref] for c in cells], dtype=h5py.ref_dtype)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(512, b" "))


@pytest.mark.parametrize(
    ("form", "lengths"), [("{}", [29]), ("run.{}", [29]), ("c{}", [19, 9])], ids=["", "s", "c"]
)
def test_variables_structs_and_cells_of_matlab_7_3_are_read(form, lengths, tmp_path):
    mat_of_version_7_3(tmp_path / "log.mat")
    columns = {"time": form.format("t"), "obs": [form.format("q")], "actions": [form.format("u")]}

    data = load(tmp_path / "log.mat", columns | {"condition": {"column": "text"}})

    assert data.lengths.tolist() == lengths and data.conditions[0] == "arm"
    np.testing.assert_array_equal(data.episode(0)[0][:, 0], TABLE["q"][: lengths[0] + 1])


def test_elements_of_an_array_of_structs_are_episodes(tmp_path):
    runs = np.empty(2, [(name, object) for name in TABLE])
    for i, m in enumerate((20, 10)):
        runs[i] = tuple(column[:m] for column in TABLE.values())
    scipy.io.savemat(tmp_path / "log.mat", {"run": runs})

    assert load(tmp_path / "log.mat", COLUMNS).lengths.tolist() == [19, 9]


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("log.csv", b"\x89HDF\r\n\x1a\n" + bytes(99), "is an HDF5 file, in spite of its name"),
        ("log.json", b"PK\x03\x04" + bytes(99), "is a zip archive, as NumPy and Excel write, in"),
        ("log.mat", b"PAR1" + bytes(99), "rename it to 'log.parquet'"),
        ("log.db3", b"nothing", "'ros2 bag reindex' or 'rosbag reindex'"),
    ],
)
def test_a_file_of_another_kind_than_its_name_says_is_told_apart(name, content, says, tmp_path):
    with pytest.raises(TrajectoryError, match=says):
        load(tmp_path / name, COLUMNS, content)


@pytest.mark.parametrize(
    ("name", "extra"),
    [("log.h5", "hdf5"), ("log.bag", "ros"), ("log.parquet", "parquet"), ("minari:a/b", "minari")],
)
def test_a_library_that_is_not_installed_is_named(name, extra, tmp_path, monkeypatch):
    for library in ("h5py", "rosbags.highlevel", "pyarrow.parquet", "minari"):
        monkeypatch.setitem(sys.modules, library, None)
    path = tmp_path / name
    if extra != "minari":
        path.write_bytes(b"x")

    with pytest.raises(TrajectoryError, match=rf"pip install sb3-hds\[{extra}\]"):
        Trajectories.load(name if extra == "minari" else path, columns=COLUMNS)


# --- bags

STAMPS = 5_000_000_000 + 10_000_000 * np.arange(N)  # [ns]
JOINTS = ("shoulder", "elbow")
BAG = {"obs": ["/joints:position[elbow]", "/joints:velocity[1]"], "actions": ["/joints:effort[1]"]}


def write_bag(path, messages, kind="db3"):
    """
    :param path: a folder, or the file of a bag of ROS 1
    :param messages: topic, time of recording [ns], type, and fields without their header
    :param kind: ``"db3"``, ``"mcap"`` or ``"bag"``
    """
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    one = kind == "bag"
    store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    with Writer1(path) if one else Writer(path, version=9, storage_plugin=plugin) as writer:
        topics = {}
        for topic, received, name, fields in messages:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, name, typestore=store)
            if "stamp" in fields:
                seconds, rest = divmod(int(fields.pop("stamp")), 10**9)
                time = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
                more = {"seq": 0} if one else {}
                header = store.types["std_msgs/msg/Header"](stamp=time, frame_id="", **more)
                fields["header"] = header
            message = store.types[name](**fields)
            pack = store.serialize_ros1 if one else store.serialize_cdr
            writer.write(topics[topic], int(received), pack(message, name))
    return path


def joint_states(stamps=STAMPS, order=JOINTS, late=None):
    """The elbow is what ``TABLE`` says, the shoulder stands still; logged ``late`` [ns]."""
    elbow, late = list(order).index("elbow"), np.zeros(N, int) if late is None else late
    for k, stamp in enumerate(stamps):
        columns = np.zeros((3, len(order)))
        columns[:, elbow] = [TABLE[name][k] for name in ("q", "v", "u")]
        fields = dict(zip(("position", "velocity", "effort"), columns, strict=True))
        fields |= {"name": list(order), "stamp": stamp}
        yield "/joints", stamp + late[k], "sensor_msgs/msg/JointState", fields


@pytest.mark.parametrize("kind", ["db3", "mcap", "bag", "alone", "folder without metadata"])
def test_a_bag_of_ros_is_read_with_its_metadata_and_without(kind, tmp_path):
    kind, path = (kind, tmp_path / "log.bag") if kind == "bag" else (kind, tmp_path / "log")
    write_bag(path, joint_states(), kind if kind in ("mcap", "bag") else "db3")
    if kind in ("alone", "folder without metadata"):
        (path / "metadata.yaml").unlink()
    if kind == "alone":
        [path] = path.iterdir()

    data = load(path, BAG)

    np.testing.assert_array_equal(data.obs[0], np.stack([TABLE["q"], TABLE["v"]], axis=1))
    np.testing.assert_array_equal(data.actions[0, :, 0], TABLE["u"][:-1])
    assert data.dt == 0.01 and not data.report.altered
    assert len(load(str(tmp_path / "l*"), BAG)) == 1


def test_joints_keep_their_names_whatever_their_order(tmp_path):
    turned = list(joint_states())
    turned[1::2] = list(joint_states(order=("elbow", "wrist")))[1::2]
    path = write_bag(tmp_path / "log", turned)

    def read(column):
        return load(path, {"obs": [column], "actions": []})

    np.testing.assert_array_equal(read("/joints:position[elbow]").obs[0, :, 0], TABLE["q"])
    sparse = read("/joints:position[wrist]")
    assert sparse.lengths.tolist() == [N // 2 - 1] and sparse.dt == pytest.approx(0.02)
    with pytest.raises(TrajectoryError, match=r"Choose them by name, as /joints:position\[elbow\]"):
        read("/joints:position[1]")
    for column in ("/joints:position[hand]", "/arm:position[elbow]"):
        with pytest.raises(TrajectoryError, match=f"has no column '{re.escape(column)}'"):
            read(column)


def more_topics():
    """A linear signal sampled at other times, with a hole, and a command without a header."""
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE).types
    for late in 7_000_000 * np.arange(-2, 50):
        if not 150_000_000 < late < 220_000_000:
            vector = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=1e-9 * float(late))
            wrench = types["geometry_msgs/msg/Wrench"](force=vector, torque=vector)
            fields = {"wrench": wrench, "stamp": STAMPS[0] + late}
            yield "/wrench", STAMPS[0] + late, "geometry_msgs/msg/WrenchStamped", fields
    for k in range(3):
        received = STAMPS[0] - 5_000_000 + 100_000_000 * k
        yield "/command", received, "std_msgs/msg/Float64", {"data": k}


@pytest.mark.filterwarnings("ignore::sb3_hds.data.SamplingWarning")
def test_topics_are_put_on_one_clock_observations_interpolated_and_actions_held(tmp_path):
    write_bag(tmp_path / "log", sorted([*joint_states(), *more_topics()], key=lambda m: m[1]))
    columns = {"obs": ["/joints:position[elbow]", "/wrench:wrench.force.z"]}
    columns["actions"] = ["/command:data"]

    data = load(tmp_path / "log", columns)

    before, after = data.episode(0), data.episode(1)
    # Of 30 rows every 10 ms, those from 150 to 220 ms lie in the hole.
    assert data.lengths.tolist() == [14, 6] and data.origin.tolist() == [0, 0]
    np.testing.assert_allclose(before[0][:, 1], T[:15], atol=1e-12)
    np.testing.assert_allclose(after[0][:, 1], T[23:], atol=1e-12)
    np.testing.assert_array_equal(before[0][:, 0], TABLE["q"][:15])
    # The second command comes 5 ms before row 10.
    np.testing.assert_array_equal(before[1][:, 0], [0.0] * 10 + [1.0] * 4)
    assert "/command:data held" in data.report.notes[0]
    with pytest.raises(TrajectoryError, match=r"/command has no header stamps.*/joints:received"):
        load(tmp_path / "log", columns | {"time": "/joints:header.stamp"})
    with pytest.raises(TrajectoryError, match="several topics are put on one clock"):
        load(tmp_path / "log", columns | {"time": "/joints:position[0]"})
    # The only number of a field is its first one.
    alone = load(tmp_path / "log", {"obs": ["/command:data[0]"], "actions": [], "time": "time"})
    assert alone.obs[0, :, 0].tolist() == [0.0, 1.0, 2.0]


def test_header_stamps_count_more_than_the_time_of_recording(tmp_path):
    path = write_bag(tmp_path / "log", joint_states(late=4_000_000 * (np.arange(N) % 2)))

    def intervals(columns):
        return load(path, BAG | columns).report.recordings[0].intervals

    assert intervals({}) == pytest.approx((0.01, 0.01, 0.01))
    shortest, _, longest = intervals({"time": "/joints:received"})
    assert (shortest, longest) == pytest.approx((0.006, 0.014))


@pytest.mark.measured
@pytest.mark.skipif("SB3_HDS_DATA" not in os.environ, reason="data outside the repository")
def test_a_published_bag_without_metadata_is_read_by_the_names_of_its_joints():
    """27.5 s at 125 Hz of the six joints of an arm, says its source."""
    path = Path(os.environ["SB3_HDS_DATA"], "ur10/ur10_exciting_trajectory.db3")

    def read(*joints):
        columns = [f"/joint_states:position[{joint}]" for joint in joints]
        return load(path, {"obs": columns, "actions": ["/joint_states:effort[5]"]})

    data = read("shoulder_pan_joint", "wrist_3_joint")

    assert data.dt == pytest.approx(1 / 125) and data.n_steps * data.dt == pytest.approx(27.5, 1e-2)
    np.testing.assert_array_equal(data.obs, read(0, 5).obs)


# --- what is in a file


def described(capsys, *words):
    assert cli.main(["columns", *map(str, words)]) == 0
    return capsys.readouterr().out


def test_what_is_printed_of_a_log_is_a_map_that_reads_it(tmp_path, capsys):
    table = {"ms": 10.0 * np.arange(N), "joint angle": 90.0 * TABLE["q"], "tau_cmd": TABLE["u"]}
    log = tmp_path / "log.csv"
    log.write_text(text(table | {"run": 0 * T}))

    shown = described(capsys, log)
    (tmp_path / "map.yml").write_text(shown)
    data = load(log, tmp_path / "map.yml")

    assert f"{N} rows, 4 columns" in shown and "time: {column: ms, unit: ms}" in shown
    assert "degrees? Then write unit: deg" in shown and "# not used: run" in shown
    assert data.report.obs == ("joint angle",) and data.report.actions == ("tau_cmd",)
    assert data.dt == 0.01


def test_maps_of_bags_and_of_nested_files_are_printed_too(tmp_path, capsys):
    write_bag(tmp_path / "bag", joint_states())
    (tmp_path / "log.json").write_text(json.dumps({"data": EPISODES}))
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for i in range(2):
            file[f"data/demo_{i}/obs/q"] = np.random.default_rng(i).normal(size=(N, 2))
            file[f"data/demo_{i}/actions"] = np.ones((N, 1))

    for name, obs in (
        ("bag", ["/joints:position[elbow]", "/joints:velocity[elbow]"]),
        ("log.json", ["q"]),
        ("log.h5", ["obs/q[0]", "obs/q[1]"]),
    ):
        (tmp_path / "map.yml").write_text(described(capsys, tmp_path / name))
        assert list(load(tmp_path / name, tmp_path / "map.yml").report.obs) == obs


def test_a_recording_needs_no_map(tmp_path, capsys):
    with Recorder(tmp_path / "log", dt=0.1, obs=["q"], actions=["u"]) as recorder:
        recorder.start([0.0])
        recorder.step([1.0], [2.0])

    assert "needs no map" in described(capsys, tmp_path / "log.jsonl")
    assert cli.main(["columns", str(tmp_path / "nowhere.csv")]) == 1
    assert "does not exist" in capsys.readouterr().err


def test_the_maps_on_the_page_about_logs_are_understood():
    page = Path(__file__).parent.parent / "docs/guide/reading_logs.md"
    maps = re.findall(r"^```yml\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)

    assert len(maps) == 9
    assert all(columns_from(yaml.safe_load(text)).obs for text in maps)
    table = page.read_text().partition("## Units")[2].partition("Prefixes")[0]
    units = re.findall(r"`([^`]+)`", table.partition("|---|")[2])
    assert len(units) > 30
    assert [unit for unit in units if unit != "scale" and unit_of(unit) is None] == []


# --- damaged files


@pytest.mark.parametrize(
    ("at", "byte", "says"),
    [
        (145, 0x08, "an array of class 6 that lacks a part"),  # complex, without an imaginary part
        (177, 0x55, "an element of type"),
        (144, 0x01, "lacks a part"),  # a cell array of numbers
    ],
)
def test_a_damaged_matlab_file_does_not_end_the_process(at, byte, says, tmp_path):
    scipy.io.savemat(tmp_path / "log.mat", TABLE)
    content = bytearray((tmp_path / "log.mat").read_bytes())
    content[at] = byte

    with pytest.raises(TrajectoryError, match=says):
        load(tmp_path / "log.mat", COLUMNS, bytes(content))


def healthy(folder):
    """A small file of each kind: name, content, and the map that reads it."""
    own = {"time": "t", "obs": ["q", "v"], "actions": ["u"]}
    lists = [
        dict(zip(TABLE, map(float, row), strict=True)) for row in zip(*TABLE.values(), strict=True)
    ]
    nested = {"data": [{k: v[:n].tolist() for k, v in TABLE.items()} for n in (10, 12)]}
    texts = {
        "comma.csv": (text(), own),
        "decimal.csv": (text(separator=";").replace(".", ","), own),
        "units.txt": (text(separator=" ").replace("\n", "\n[s] [deg] [deg/s] [Nm]\n", 1), own),
        "names.csv": (text(names=False), {"time": 0, "obs": [1, 2], "actions": [3]}),
        "records.json": (json.dumps({"mass": 1, "rows": lists}), own),
        "episodes.json": (json.dumps(nested), own | {"records": "data"}),
        "lines.jsonl": ("\n".join(map(json.dumps, lists)), own),
    }
    files = {name: (content.encode(), columns) for name, (content, columns) in texts.items()}
    np.savez(folder / "log.npz", **TABLE)
    scipy.io.savemat(folder / "log.mat", TABLE)
    cells = {name: np.empty(2, object) for name in TABLE}
    for name, column in TABLE.items():
        cells[name][:] = [column, column[:20]]
    scipy.io.savemat(folder / "cells.mat", cells | {"rig": {"name": "arm"}})
    scipy.io.savemat(folder / "small.mat", TABLE, do_compression=True)
    scipy.io.savemat(folder / "old.mat", TABLE, format="4")
    mat_of_version_7_3(folder / "new.mat")
    pandas.DataFrame(TABLE | {"x": list(np.ones((N, 2)))}).to_parquet(folder / "log.parquet")
    with h5py.File(folder / "log.h5", "w") as file:
        for name, column in TABLE.items():
            file[f"data/demo_0/{name}"] = column
    for kind in ("db3", "mcap", "bag"):
        target = folder / ("log.bag" if kind == "bag" else kind)
        write_bag(target, joint_states(), kind)
        if target.is_dir():
            [file] = target.glob(f"*.{kind}")
            shutil.copy(file, folder / f"log.{kind}")
            shutil.rmtree(target)
    for path in folder.iterdir():
        bag = path.suffix in (".db3", ".mcap", ".bag")
        more = {"obs": ["x[0]", "q"]} if path.suffix == ".parquet" else {}
        files[path.name] = (path.read_bytes(), BAG if bag else own | more)
    return files


def damaged(content, rng):
    """Bytes changed, cut off, left out, put in, or repeated elsewhere."""
    broken = bytearray(content)
    i, j = rng.integers(len(broken), size=2)
    some = int(rng.integers(1, 40))
    match rng.integers(5):
        case 0:
            for k in rng.integers(len(broken), size=some % 6 + 1):
                broken[k] = rng.integers(256)
        case 1:
            del broken[i:]
        case 2:
            del broken[i : i + some]
        case 3:
            broken[i:i] = rng.bytes(some)
        case 4:
            broken[i : i + some] = broken[j : j + some]
    return bytes(broken)


@pytest.mark.filterwarnings("ignore::sb3_hds.data.SamplingWarning")
def test_a_damaged_file_is_read_or_refused_in_one_line(tmp_path):
    rng = np.random.default_rng(0)
    files = healthy(tmp_path)
    for name, (content, columns) in files.items():
        path = tmp_path / name
        path.write_bytes(content)
        assert Trajectories.load(path, columns=columns).n_steps >= 20, name
        for _ in range(8):
            path.write_bytes(damaged(content, rng))
            try:
                Trajectories.load(path, columns=columns)
            except TrajectoryError as error:
                assert len(str(error).splitlines()) == 1 and len(str(error)) < 3000, name
