"""Recordings: what was recorded before the process died is readable, and nothing is overwritten."""

import itertools
import re
import signal
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from cases import each
from gymnasium import spaces
from odd_envs import AnySpaces

from sb3_hds import Trajectories
from sb3_hds.data import Recorder
from sb3_hds.errors import TrajectoryError
from sb3_hds.wrappers import Record

# Counts its steps into its observation, so that a reader can tell what it lost.
SCRIPT = """
import sys
from sb3_hds.data import Recorder

with Recorder(sys.argv[1], dt=0.01, obs=["k", "square"], actions=["u"]) as recorder:
    recorder.start([0, 0])
    for k in range(1, 10**9):
        recorder.step([-k], [k, k * k])
        if k in (1, 500):
            print(k, flush=True)
"""


def recorder(path, **settings):
    return Recorder(path, 0.1, **({"obs": ["q", "v"], "actions": ["u"]} | settings))


def begun(path):
    robot = recorder(path)
    robot.start([0.0, 0.0])
    return robot


def test_an_environment_is_recorded_as_it_was_seen(tmp_path):
    env = Record(gymnasium.make("Pendulum-v1", max_episode_steps=7), tmp_path / "run")
    obs, actions = [], []
    for episode in range(3):
        obs.append([env.reset(seed=episode)[0]])
        actions.append([])
        truncated = False
        while not truncated:
            actions[-1].append(env.action_space.sample())
            seen, _, _, truncated, _ = env.step(actions[-1][-1])
            obs[-1].append(seen)
    env.close()

    data = Trajectories.load(tmp_path / "run.jsonl")

    np.testing.assert_array_equal(data.obs, np.array(obs, np.float64))
    np.testing.assert_array_equal(data.actions, np.array(actions, np.float64))
    assert (data.dt, data.report.obs[2], data.report.altered) == (0.05, "obs[2]", False)


def test_everything_before_a_kill_is_readable(tmp_path):
    path, wanted = tmp_path / "run.jsonl", 500
    process = subprocess.Popen([sys.executable, "-c", SCRIPT, path], stdout=subprocess.PIPE)
    assert process.stdout is not None
    for line in process.stdout:
        if int(line) == wanted:
            break
    process.send_signal(signal.SIGKILL)

    assert process.wait() == -signal.SIGKILL
    data = Trajectories.load(path)
    k = np.arange(data.n_steps + 1)
    assert data.n_steps >= wanted
    np.testing.assert_array_equal(data.obs[0], np.stack([k, k**2], axis=1))
    np.testing.assert_array_equal(data.actions[0, :, 0], -k[1:])


def test_a_file_that_is_cut_anywhere_loses_one_step_at_most(tmp_path):
    with begun(tmp_path / "run") as whole:
        for k in range(4):
            whole.step([k], [k + 1.0, 0.5])
    content, path = whole.path.read_bytes(), whole.path
    ends = [i for i, byte in enumerate(content) if byte == ord("\n")]

    for size in range(0, len(content) + 1, 3):
        path.write_bytes(content[:size])
        n_steps = sum(end < size for end in ends) - 2  # without header and first observation
        if n_steps < 1:
            with pytest.raises(TrajectoryError, match=r"interrupted before|contains no step yet"):
                Trajectories.load(path)
        else:
            assert Trajectories.load(path).obs[0, :, 0].tolist() == list(range(n_steps + 1))
    lines = content.splitlines(keepends=True)
    path.write_bytes(b"".join([*lines[:3], lines[3][:-10] + b"\n", *lines[4:]]))
    with pytest.raises(TrajectoryError, match=r"Line 4 of '.*run.jsonl' is damaged"):
        Trajectories.load(path)


def test_a_loop_without_an_environment_and_its_conditions(tmp_path):
    clock = itertools.count(100.0, 0.1)
    with recorder(tmp_path / "run", clock=lambda: next(clock), condition="empty") as robot:
        for label in ("empty", "loaded"):
            robot.condition = label
            robot.start([0.0, 1.0])
            for k in range(4):
                robot.step([k], [k, 1.0])
        robot.start([5.0, 5.0])  # an episode without a step is no trajectory

    data = Trajectories.load(tmp_path / "run.jsonl")

    assert data.conditions == ("empty", "loaded") and data.lengths.tolist() == [4, 4]
    assert data.actions[1, :, 0].tolist() == [0.0, 1.0, 2.0, 3.0]


def test_a_recording_is_never_overwritten_but_can_be_continued(tmp_path):
    for run in range(2):
        with recorder(tmp_path / "run", append=True) as robot:
            robot.start([run, 0.0])
            robot.step([1.0], [run, 1.0])
        with robot.path.open("ab") as file:
            file.write(b'{"time":0.2,"act')  # what a kill leaves behind

    assert Trajectories.load(robot.path).obs[:, 0, 0].tolist() == [0.0, 1.0]
    with pytest.raises(TrajectoryError, match="exists; recordings are never overwritten"):
        recorder(tmp_path / "run")
    with pytest.raises(TrajectoryError, match="has a different interval or different channels"):
        recorder(tmp_path / "run", append=True, actions=["torque"])


def test_a_file_that_is_no_recording_is_never_touched(tmp_path):
    path = tmp_path / "notes.jsonl"
    path.write_text('{"my": "only copy"}')

    with pytest.raises(TrajectoryError, match="is not a recording: it begins with"):
        recorder(path, append=True)
    assert path.read_text() == '{"my": "only copy"}'

    # A kill can leave the first half of a header, which is nobody's only copy.
    with recorder(tmp_path / "run"):
        header = (tmp_path / "run.jsonl").read_bytes()
    (tmp_path / "run.jsonl").write_bytes(header[:30])
    with recorder(tmp_path / "run", append=True):
        assert (tmp_path / "run.jsonl").read_bytes() == header


@each(
    (lambda path: recorder(path.parent / "no" / "where"), "must exist and be writable"),
    (lambda path: recorder(path, obs=[]), "at least one observation channel"),
    (lambda path: recorder(path, obs=["u", "q"]), "a name of its own"),
    (lambda path: recorder(path, obs=["time"]), "other than time and condition"),
    (lambda path: recorder(path).step([0.0], [0.0, 0.0]), "call start(obs)"),
    (lambda path: recorder(path).start([0.0]), "obs must have 2 numbers (q, v)"),
    (lambda path: begun(path).step(["a"], [0.0, 0.0]), "action must hold numbers (u)"),
    (lambda path: begun(path).step([0.0], [0.0, 0.0], time=np.nan), "time must be finite"),
    (lambda path: Recorder(path, 0.0, obs=["q"], actions=[]), "dt must be the sampling"),
    (lambda path: Record(AnySpaces(), path), "does not say how long a step is"),
    (lambda path: Record(AnySpaces(spaces.Box(0.0, 1.0, (4, 4))), path, dt=0.1), "Flatten"),
)
def test_wrong_use_is_refused_with_the_way_out(use, says, tmp_path):
    with pytest.raises(TrajectoryError, match=re.escape(says)):
        use(tmp_path / "run")


def test_what_is_refused_costs_nothing_that_was_recorded_whatever_the_actions_are(tmp_path):
    with begun(tmp_path / "a") as robot:
        robot.step([1.0], [1.0, 1.0])
        with pytest.raises(TrajectoryError, match="This was not recorded"):
            robot.step([2.0], [np.nan, 2.0])
        with pytest.raises(TrajectoryError, match="must not decrease"):
            robot.step([2.0], [2.0, 2.0], time=0.0)
        robot.step([3.0], [3.0, 3.0])
    choosing = AnySpaces(action_space=spaces.Discrete(3))
    env = Record(choosing, tmp_path / "b", dt=0.1, action_names=["gear"])
    env.reset()
    env.step(2)
    env.close()

    data, discrete = (Trajectories.load(tmp_path / f"{name}.jsonl") for name in "ab")

    np.testing.assert_array_equal(data.obs[0], [[0.0, 0.0], [1.0, 1.0], [3.0, 3.0]])
    np.testing.assert_array_equal(data.actions[0], [[1.0], [3.0]])
    assert discrete.actions.tolist() == [[[2.0]]] and discrete.report.actions == ("gear",)
    with pytest.raises(TrajectoryError, match="is closed"):
        env.step(1)
    with pytest.raises(TrajectoryError, match="must have the same obs"):
        Trajectories.load(str(tmp_path / "*.jsonl"))
