"""Files as people have them: layouts, units, nesting, bags; and damaged ones."""

import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import yaml
from cases import each
from damage import damaged

from sb3_hds import Trajectories, audit, cli, twins
from sb3_hds.data import Recorder
from sb3_hds.data.columns import columns_from
from sb3_hds.data.conversion import unit_of
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
    lines = [separator.join(map(str, row)) for row in zip(*table.values(), strict=True)]
    return "\n".join([separator.join(table)] * names + lines) + "\n"


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


@each(
    (lay("t;q;u", ";", ","), {}),
    (lay("t q u", " ", ","), {}),
    (lay("t;q;u;", ";", end=";"), {}),
    (lay("t q u\n[s] [rad] [Nm]", " "), {}),
    (lay("t,q,u\n(ms),(mrad),(-)", rows=MILLI), {}),
    (lay("# rig 3, Monday\n# Tuesday\nt,q,u"), {}),
    (lay("% t q u", " "), {}),
    (lay("sep=;\nt;q;u", ";"), {}),
    (lay("rig 3\n\nt,q,u"), {"skip": 1}),
    (lay(""), BY_NUMBER),
    (lay("0,1,2"), BY_NUMBER),
    (lay("%time,q,u", rows=NANO), {"time": "%time"}),
    (lay("sec,nanosec,q,u", rows=SPLIT), STAMPED),
    (lay("t [ms];a [mrad];u", ";", rows=MILLI), {"time": "t [ms]", "obs": ["a [mrad]"]}),
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
    # Decimal commas may come late.
    lines = [f"{i};0;0" for i in range(100)] + [f"{i};{i},5;0" for i in range(100, 200)]
    data = load(tmp_path / "log.csv", COLUMNS, "\n".join(["t;q;u", *lines]))
    assert data.obs[0, 150, 0] == 150.5


# Doubles of the size of the last ones are 256 ns apart.
@pytest.mark.parametrize(("unit", "per_second"), [("s", 1), ("ms", 10**3), ("ns", 10**9)])
def test_time_stamps_since_1970_are_recognised_by_their_size_and_not_rounded(
    unit, per_second, tmp_path
):
    step = 10_000 if unit == "ns" else per_second
    rows = [(f"{1_700_000_000 * per_second + step * k}", "0", "0") for k in range(9)]

    data = load(tmp_path / "log.csv", COLUMNS, lay("t,q,u", rows=rows))

    assert data.dt == pytest.approx(step / per_second, rel=1e-9) and not data.report.altered
    assert data.report.notes == ((f"t counts {unit} since 1970.",) if unit != "s" else ())


@each(
    ("deg", np.pi / 180.0, "rad"),
    ("turns", 2.0 * np.pi, "rad"),
    ("N mm", 1e-3, "N m"),
    ("kgf cm", 0.0980665, "N m"),
    ("g0", 9.80665, "m/s2"),
    ("%", 0.01, "1"),
    ("N\N{MIDDLE DOT}m\N{MIDDLE DOT}s/rad", 1.0, "N m s/rad"),
)
def test_a_unit_has_a_factor_to_a_name_in_the_si(unit, factor, name):
    assert unit_of(unit).factor == pytest.approx(factor, rel=1e-12) and unit_of(unit).name == name


@each(
    ({"obs": [{"column": "q", "unit": "furlong"}]}, "unknown unit 'furlong'. Known are rad"),
    ({"obs": [{"column": "q", "unit": "counts"}]}, "counts need a scale"),
    ({"obs": [{"column": "q", "unit": "mm", "angle": True}]}, "an angle must be in rad, deg or"),
    ({"time": {"column": "t", "unit": "deg"}}, "time must be in one of s, ms, us"),
)
def test_a_unit_that_cannot_be_converted_is_refused(change, says):
    with pytest.raises(TrajectoryError, match=says):
        columns_from(COLUMNS | change)


def test_columns_are_converted_and_a_scale_counts_more_than_a_unit_in_the_file(tmp_path):
    content = text({"t": 1000.0 * T, "q": np.arange(N), "a": 180.0 * T, "u": T})
    columns = {"time": {"column": "t", "unit": "ms"}, "actions": [{"column": "u", "unit": "kN"}]}
    columns["obs"] = [{"column": "q", "unit": "ticks", "scale": 0.5}]
    columns["obs"].append({"column": "a", "unit": "deg", "offset": 1.0})

    data = load(tmp_path / "log.csv", columns, content)
    scaled = COLUMNS | {"obs": [{"column": "q", "scale": 10.0}]}
    other = load(tmp_path / "other.csv", scaled, "t,q,u\ns,deg,N\n0,1,0\n1,2,0\n")

    assert data.dt == 0.01 and data.obs[0, 3, 0] == 1.5 and data.report.units == ("", "rad")
    np.testing.assert_allclose(data.obs[0, :, 1], 1.0 + np.pi * T, rtol=1e-12)
    np.testing.assert_allclose(data.actions[0, :, 0], 1000.0 * T[:-1], rtol=1e-12)
    assert other.obs[0, :, 0].tolist() == [10.0, 20.0]


def test_files_that_name_different_units_are_distinguished(tmp_path):
    (tmp_path / "a.csv").write_text("t,q,u\ns,deg,N\n0,1,0\n1,2,0\n")
    (tmp_path / "b.csv").write_text("t,q,u\n0,1,0\n1,2,0\n")
    with pytest.raises(TrajectoryError, match=r"'q' is in deg in .*obs: \[{column: q, unit: UNIT}"):
        load(str(tmp_path / "*.csv"), COLUMNS)


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


EPISODES = [{"t": [0.1 * k for k in range(n)], "q": [*range(n)], "u": [0] * n} for n in (5, 2)]
RECORDS = [
    [dict(zip(e, row, strict=True)) for row in zip(*e.values(), strict=True)] for e in EPISODES
]
ALL_ROWS = [{"run": i} | row for i, rows in enumerate(RECORDS) for row in rows]
KEYED = {key: {str(k): x for k, x in enumerate(EPISODES[0][key])} for key in "tq"}


@each(
    (EPISODES, {}, [4, 1]),
    ({"config": {"hz": 10}, "data": EPISODES}, {}, [4, 1]),
    ({"data": EPISODES, "old": EPISODES[:1]}, {"records": "data"}, [4, 1]),
    ({"a": {"b": EPISODES}, "c": [{"x": 1}]}, {"records": "a.b"}, [4, 1]),
    ({"run_2": EPISODES[0], "run_10": EPISODES[1]}, {}, [4, 1]),
    ({"data": {"wide": EPISODES[0], "xs": EPISODES[1]}}, {"records": "data"}, [4, 1]),
    ([{"load": 3, "steps": rows} for rows in RECORDS], {}, [4, 1]),
    ({key: [episode[key] for episode in EPISODES] for key in "tqu"}, {}, [4, 1]),
    (ALL_ROWS, {"episode": "run"}, [4, 1]),
    (RECORDS[0], {}, [4]),
    ([{"t": 0.1 * k, "s": {"q": [9, k]}, "u": 0} for k in range(5)], {"obs": ["s.q[1]"]}, [4]),
    (KEYED | {"u": 0}, {}, [4]),
    ([[0.1 * k, k, 0] for k in range(5)], BY_NUMBER, [4]),
)
def test_episodes_are_found_wherever_json_nests_them(content, more, lengths, tmp_path):
    data = load(tmp_path / "log.json", COLUMNS | more, json.dumps(content))

    assert data.lengths.tolist() == lengths and data.dt == 0.1
    assert data.obs[0, :, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    with pytest.raises(TrajectoryError, match="on the path records"):
        load(tmp_path / "log.json", COLUMNS | {"records": "data.x.y"})


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


@each(("data/demo_{}", {}), ("{}", {}), ("a/x{}", {"records": "a"}))
def test_groups_of_hdf5_are_episodes(groups, more, tmp_path):
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for i, n in ((2, 10), (10, 7)):
            group = file.create_group(groups.format(i))
            group["obs/q"] = np.arange(n + 1.0)[:, None] * [1.0, 10.0]
            group["act"] = np.ones((n, 1))
        file["names"] = ["a", "b"]
    columns = {"dt": 0.1, "obs": ["obs/q[1]"], "actions": ["act[0]"]}

    data = load(tmp_path / "log.h5", columns | more)

    assert data.lengths.tolist() == [10, 7] and data.obs[0, 3, 0] == 30.0


def test_the_first_of_three_axes_counts_episodes(tmp_path):
    obs = np.random.default_rng(0).normal(size=(3, 11, 2))
    np.savez(tmp_path / "log.npz", x=obs, u=np.zeros((3, 10, 1)), load=np.array(["a", "b", "b"]))
    columns = {"dt": 0.1, "obs": ["x[0]", "x[1]"], "actions": ["u[0]"]}

    data = load(tmp_path / "log.npz", columns | {"condition": {"column": "load"}})

    np.testing.assert_array_equal(data.obs, obs)
    assert data.conditions == ("a", "b", "b") and data.lengths.tolist() == [10] * 3


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


def test_a_library_that_is_not_installed_is_named(tmp_path, monkeypatch):
    for library in ("h5py", "rosbags.highlevel", "pyarrow.parquet", "minari"):
        monkeypatch.setitem(sys.modules, library, None)

    for name, extra in (("log.h5", "hdf5"), ("log.bag", "ros"), ("log.parquet", "parquet")):
        with pytest.raises(TrajectoryError, match=rf"pip install sb3-hds\[{extra}\]"):
            load(tmp_path / name, COLUMNS, b"x")
    with pytest.raises(TrajectoryError, match=r"pip install sb3-hds\[minari\]"):
        Trajectories.load("minari:a/b", columns=COLUMNS)


STAMPS = 5_000_000_000 + 10_000_000 * np.arange(N)  # [ns]
JOINTS = ("shoulder", "elbow")
BAG = {"obs": ["/joints:position[elbow]", "/joints:velocity[1]"], "actions": ["/joints:effort[1]"]}


def write_bag(path, messages, kind="db3"):
    """Of topic, time of recording [ns], type, and fields without their header."""
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


def test_a_folder_of_ros_is_read_with_its_metadata_and_without(tmp_path):
    path = write_bag(tmp_path / "log", joint_states())

    for _ in range(2):
        data = load(str(tmp_path / "l*"), BAG)
        np.testing.assert_array_equal(data.obs[0], np.stack([TABLE["q"], TABLE["v"]], axis=1))
        (path / "metadata.yaml").unlink(missing_ok=True)


def test_joints_keep_their_names_whatever_their_order(tmp_path):
    turned = list(joint_states())
    turned[1::2] = list(joint_states(order=("elbow", "wrist")))[1::2]
    path = write_bag(tmp_path / "log", turned)

    def read(column):
        return load(path, {"obs": [column], "actions": []})

    np.testing.assert_array_equal(read("/joints:position[elbow]").obs[0, :, 0], TABLE["q"])
    sparse = read("/joints:position[wrist]")
    assert sparse.lengths.tolist() == [N // 2 - 1] and sparse.dt == pytest.approx(0.02)
    with pytest.raises(TrajectoryError, match=r"Select them by name, as /joints:position\[elbow\]"):
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
    with pytest.raises(TrajectoryError, match="several topics need a common clock"):
        load(tmp_path / "log", columns | {"time": "/joints:position[0]"})


def test_header_stamps_count_more_than_the_time_of_recording(tmp_path):
    path = write_bag(tmp_path / "log", joint_states(late=4_000_000 * (np.arange(N) % 2)))

    def intervals(columns):
        return load(path, BAG | columns).report.recordings[0].intervals

    assert intervals({}) == pytest.approx((0.01, 0.01, 0.01))
    shortest, _, longest = intervals({"time": "/joints:received"})
    assert (shortest, longest) == pytest.approx((0.006, 0.014))


def described(capsys, path):
    assert cli.main(["columns", str(path)]) == 0
    return capsys.readouterr().out


def test_what_is_printed_of_a_log_is_a_map_that_reads_it(tmp_path, capsys):
    table = {"ms": 10.0 * np.arange(N), "joint angle": 90.0 * TABLE["q"], "tau_cmd": TABLE["u"]}
    log = tmp_path / "log.csv"
    log.write_text(text(table | {"run": 0 * T}))

    shown = described(capsys, log)
    (tmp_path / "map.yml").write_text(shown)
    data = load(log, tmp_path / "map.yml")

    assert f"{N} rows, 4 columns" in shown and "time: {column: ms, unit: ms}" in shown
    assert "degrees? Then add unit: deg" in shown and "# not used: run" in shown
    assert data.report.obs == ("joint angle",) and data.report.actions == ("tau_cmd",)
    assert data.dt == 0.01


def test_an_uneven_first_column_that_always_rises_is_time(tmp_path, capsys):
    """Without names; rather than a steadier one behind it, unless it stands still."""
    times = 1017.78 + np.cumsum(np.random.default_rng(0).choice([0.01, 0.01, 0.012], N))
    other = np.column_stack([np.sin(40.0 * times), 1.0 * np.arange(N)])
    held = np.where(np.arange(N) == 5, times[4], times)
    for name, first in (("rising", times), ("held", held)):
        np.savetxt(tmp_path / f"{name}.csv", np.column_stack([first, other]), "%.6f", ",")

    assert "time: {column: '0'}" in described(capsys, tmp_path / "rising.csv")
    assert "time: {column: '2'" in described(capsys, tmp_path / "held.csv")


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
    with Recorder(tmp_path / "log", dt=0.1, obs=["q"], actions=["u"]) as recorder:
        recorder.start([0.0])
        recorder.step([1.0], [2.0])
    assert "needs no map" in described(capsys, tmp_path / "log.jsonl")
    assert cli.main(["columns", str(tmp_path / "nowhere.csv")]) == 1
    assert "does not exist" in capsys.readouterr().err


def test_the_maps_on_the_page_about_logs_are_understood():
    page = Path(__file__).parent.parent / "docs/guide/reading_logs.md"
    maps = re.findall(r"^```yml\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)

    assert len(maps) == 9 and all(columns_from(yaml.safe_load(text)).obs for text in maps)
    table = page.read_text().partition("## Units")[2].partition("Prefixes")[0]
    units = re.findall(r"`([^`]+)`", table.partition("|---|")[2])
    assert len(units) > 30
    assert [unit for unit in units if unit != "scale" and unit_of(unit) is None] == []


@each(
    (145, 0x08, "an array of class 6 that lacks a part"),  # complex, without an imaginary part
    (177, 0x55, "an element of type"),
    (144, 0x01, "lacks a part"),  # a cell array of numbers
)
def test_a_damaged_matlab_file_does_not_end_the_process(at, byte, says, tmp_path):
    scipy.io.savemat(tmp_path / "log.mat", TABLE)
    content = bytearray((tmp_path / "log.mat").read_bytes())
    content[at] = byte

    with pytest.raises(TrajectoryError, match=says):
        load(tmp_path / "log.mat", COLUMNS, bytes(content))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A small file of each kind: name, content, and the map that reads it."""
    folder = tmp_path_factory.mktemp("healthy")
    own = {"time": "t", "obs": ["q", "v"], "actions": ["u"]}
    every = zip(*TABLE.values(), strict=True)
    lists = [dict(zip(TABLE, map(float, row), strict=True)) for row in every]
    nested = {"data": [{k: v[:n].tolist() for k, v in TABLE.items()} for n in (10, 12)]}
    texts = {
        "comma.csv": (text(), own),
        "decimal.csv": (text(separator=";").replace(".", ","), own),
        "units.txt": (text(separator=" ").replace("\n", "\n[s] [rad] [rad/s] [N]\n", 1), own),
        "names.csv": (text(names=False), {"time": 0, "obs": [1, 2], "actions": [3]}),
        "records.json": (json.dumps({"mass": 1, "rows": lists}), own),
        "episodes.json": (json.dumps(nested), own | {"records": "data"}),
        "lines.jsonl": ("\n".join(map(json.dumps, lists)), own),
    }
    files = {name: (content.encode(), columns) for name, (content, columns) in texts.items()}
    np.savez(folder / "log.npz", **TABLE)
    rows = np.array(list(zip(*TABLE.values(), strict=True)), [(name, float) for name in TABLE])
    np.savez(folder / "fields.npz", run=rows, note="hello")
    np.save(folder / "log.npy", np.stack(list(TABLE.values()), axis=1))
    scipy.io.savemat(folder / "log.mat", TABLE)
    cells = {name: np.empty(2, object) for name in TABLE}
    for name, column in TABLE.items():
        cells[name][:] = [column[:20], column[:10]]
    scipy.io.savemat(folder / "cells.mat", cells | {"rig": {"name": "arm"}})
    runs = np.empty(2, [(name, object) for name in TABLE])
    runs[:] = list(zip(*cells.values(), strict=True))
    scipy.io.savemat(folder / "structs.mat", {"run": runs})
    scipy.io.savemat(folder / "small.mat", TABLE, do_compression=True)
    scipy.io.savemat(folder / "old.mat", TABLE, format="4")
    for name in ("new", "new struct", "new cells"):
        mat_of_version_7_3(folder / f"{name}.mat")
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
    maps = dict.fromkeys(("log.db3", "log.mcap", "log.bag"), BAG)
    maps["log.npy"] = texts["names.csv"][1]
    maps["log.parquet"] = own | {"obs": ["q", "x[0]"]}
    forms = {"fields.npz": "run.{}", "new struct.mat": "run.{}", "new cells.mat": "c{}"}
    for name, form in forms.items():
        t, q, u = map(form.format, "tqu")
        maps[name] = {"time": t, "obs": [q], "actions": [u]}
    maps["new cells.mat"]["condition"] = {"column": "text"}
    written = {path.name: path.read_bytes() for path in folder.iterdir()}
    return files | {name: (content, maps.get(name, own)) for name, content in written.items()}


def test_a_log_of_any_format_holds_observation_k_and_the_action_that_follows_it(files, tmp_path):
    for name, (content, columns) in files.items():
        data = load(tmp_path / name, columns, content)

        obs, actions = data.episode(0)
        np.testing.assert_array_equal(obs[:, 0], TABLE["q"][: len(obs)], name)
        np.testing.assert_array_equal(actions[:, 0], TABLE["u"][: len(actions)], name)
        assert data.dt == 0.01 and not data.report.altered and data.n_steps >= 20, name
        assert data.conditions[0] == ("arm" if "condition" in columns else "default"), name


@pytest.mark.filterwarnings("ignore::sb3_hds.data.SamplingWarning")
def test_a_damaged_file_is_read_or_refused_in_one_line(files, tmp_path):
    for name, (content, columns) in files.items():
        for broken in damaged(content, 8):
            try:
                load(tmp_path / name, columns, broken)
            except TrajectoryError as error:
                assert len(str(error).splitlines()) == 1 and len(str(error)) < 3000, name
