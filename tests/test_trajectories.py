"""Measured data: checked at the door, padded, cut, split, resampled, saved."""

import os
import re
import zipfile

import gymnasium as gym
import jax
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_hds.core import Trajectories
from sb3_hds.errors import TrajectoryError


def recording(*lengths, n_obs=2, n_act=1, seed=0):
    """Random observations and actions, one pair of arrays per length."""
    rng = np.random.default_rng(seed)
    obs = [rng.normal(size=(n + 1, n_obs)) for n in lengths]
    actions = [rng.normal(size=(n, n_act)) for n in lengths]
    return obs, actions


def data_of(*lengths, conditions=None, dt=0.1, **kwargs):
    obs, actions = recording(*lengths, **kwargs)
    return Trajectories.from_arrays(obs=obs, actions=actions, dt=dt, conditions=conditions)


def assert_same(one, other):
    assert (one.dt, one.conditions, len(one)) == (other.dt, other.conditions, len(other))
    np.testing.assert_array_equal(one.origin, other.origin)
    for i in range(len(one)):
        for ours, theirs in zip(one.episode(i), other.episode(i), strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_episodes_come_out_as_they_went_in():
    obs, actions = recording(3, 7, 1)

    data = Trajectories.from_arrays(obs=obs, actions=actions, dt=0.1)

    for i in range(3):
        np.testing.assert_array_equal(data.episode(i)[0], obs[i])
        np.testing.assert_array_equal(data.episode(i)[1], actions[i])
    assert data.lengths.tolist() == [3, 7, 1]
    assert (len(data), data.n_steps, data.n_obs, data.n_act) == (3, 11, 2, 1)
    # Padding repeats the last observation and commands nothing.
    np.testing.assert_array_equal(data.obs[0, 4:], np.stack([obs[0][-1]] * 4))
    np.testing.assert_array_equal(data.actions[0, 3:], 0.0)
    assert data.mask[0].tolist() == [True] * 3 + [False] * 4
    whole = Trajectories.from_arrays(np.arange(12).reshape(2, 3, 2), np.zeros((2, 2, 1)), dt=1.0)
    assert whole.obs.dtype == np.float64 and whole.obs[1, 2].tolist() == [10.0, 11.0]


def spoilt(obs, value):
    obs[1][2, 1] = obs[1][4, 0] = value
    return obs


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda obs, u: (obs, [u[0][:-1], u[1]]), "obs[0] must have one row more than actions[0]"),
        (lambda obs, u: ([x[1:] for x in obs], u), "drop that one: actions=[a[:-1] for a"),
        (lambda obs, u: (u, obs), "Are obs and actions swapped?"),
        (lambda obs, u: ([obs[0][:1], obs[1]], [u[0][:0], u[1]]), "must be at least one action"),
        (lambda obs, u: (obs[0], u[0]), "obs[0] must have shape (T + 1, n_obs), got (2,)"),
        (lambda obs, u: (obs, u[:1]), "one array per trajectory, got 2 in obs and 1 in actions."),
        (lambda obs, u: ([], []), "one array per trajectory, got 0 in obs and 0 in actions."),
        (lambda obs, u: ([obs[0], obs[1][:, :1]], u), "All trajectories must have the same chan"),
        (lambda obs, u: (obs, [u[0], u[1].astype(str)]), "actions[1] must be an array of real"),
        (lambda obs, u: ([[[1.0, 2.0], [3.0]], obs[1]], u), "obs[0] must be an array of real"),
        (lambda obs, u: (spoilt(obs, np.nan), u), "got nan at row 2, column 1 (2 such values"),
        (lambda obs, u: (spoilt(obs, -np.inf), u), "obs[1] must be finite, got -inf"),
    ],
)
def test_arrays_that_are_no_trajectories_are_refused_with_the_way_out(change, message):
    obs, actions = change(*recording(3, 5))

    with pytest.raises(TrajectoryError, match=re.escape(message)):
        Trajectories.from_arrays(obs=obs, actions=actions, dt=0.1)


@pytest.mark.parametrize("dt", [0.0, -0.1, np.nan, np.inf])
def test_an_impossible_interval_is_refused(dt):
    obs, actions = recording(3)

    with pytest.raises(TrajectoryError, match=f"interval in seconds, .* got {dt!r}"):
        Trajectories.from_arrays(obs=obs, actions=actions, dt=dt)


def test_conditions_are_one_per_trajectory_or_one_for_all():
    assert data_of(3, 4).conditions == ("default", "default")
    assert data_of(3, 4, conditions="heavy").conditions == ("heavy", "heavy")
    assert data_of(3, 4, conditions=[0.5, "light"]).conditions == ("0.5", "light")
    message = "conditions must hold one label per trajectory, got 1 for 2."
    with pytest.raises(TrajectoryError, match=re.escape(message)):
        data_of(3, 4, conditions=["heavy"])


def test_arrays_that_do_not_fit_together_are_refused():
    data = data_of(3, 4)
    hole = data.mask.copy()
    hole[1, 1] = False

    with pytest.raises(TrajectoryError, match="do not fit"):
        Trajectories(data.obs[:, 1:], data.actions, data.mask, 0.1, ("a", "b"), data.origin)
    with pytest.raises(TrajectoryError, match="mask must be True for the first steps"):
        Trajectories(data.obs, data.actions, hole, 0.1, ("a", "b"), data.origin)


def test_indexing_gives_trajectories_padded_no_longer_than_needed():
    data = data_of(3, 7, 5, conditions=["a", "b", "c"])

    one, some, rest = data[-1], data[np.array([2, 0])], data[1:]

    assert (len(one), one.actions.shape, one.conditions) == (1, (1, 5, 1), ("c",))
    assert (some.conditions, some.origin.tolist()) == (("c", "a"), [2, 0])
    np.testing.assert_array_equal(some.episode(1)[0], data.episode(0)[0])
    assert rest.lengths.tolist() == [7, 5]
    assert_same(data[data.lengths > 4], rest)
    assert [len(part) for part in data] == [1, 1, 1]
    with pytest.raises(IndexError):
        data[3]
    with pytest.raises(TrajectoryError, match="selects none of 3 trajectories"):
        data[3:]


def test_it_is_a_pytree_whose_labels_are_static():
    data = data_of(3, 7, conditions=["a", "b"])

    doubled = jax.tree.map(lambda leaf: 2 * leaf, data)
    sums = jax.jit(jax.vmap(lambda one: one.obs.sum() + one.actions.sum()))(data)

    assert (doubled.dt, doubled.conditions) == (0.1, ("a", "b"))
    np.testing.assert_array_equal(doubled.obs, 2 * data.obs)
    # float32 sums of 24 numbers of size one
    np.testing.assert_allclose(
        sums, data.obs.sum((1, 2)) + data.actions.sum((1, 2)), rtol=1e-5, atol=1e-5
    )
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(data)]
    assert paths == [".obs", ".actions", ".mask", ".origin"]


# --- windows and splits


def test_windows_lie_inside_real_data_and_know_where_they_are_from():
    data = data_of(3, 8, 2, conditions=["a", "b", "c"])

    windows = data.windows(3, stride=2)

    assert windows.origin.tolist() == [0, 1, 1, 1]
    assert windows.conditions == ("a", "b", "b", "b")
    assert windows.mask.all() and windows.actions.shape == (4, 3, 1)
    for window, start in ((1, 0), (2, 2), (3, 4)):
        np.testing.assert_array_equal(windows.obs[window], data.obs[1, start : start + 4])
        np.testing.assert_array_equal(windows.actions[window], data.actions[1, start : start + 3])


def test_windows_do_not_overlap_unless_asked():
    assert len(data_of(10).windows(3)) == 3
    assert data_of(8, 12).windows(4)[2:].windows(2).origin.tolist() == [1] * 6
    with pytest.raises(TrajectoryError, match=r"No trajectory has 11 steps; the longest has 10\."):
        data_of(10).windows(11)
    with pytest.raises(TrajectoryError, match="length and stride must be at least 1 step"):
        data_of(10).windows(0)


def test_a_split_shares_no_recording_even_among_windows():
    windows = data_of(9, 9, 9, 9, 9).windows(3, stride=1)

    for seed in range(5):
        first, second = windows.split(fraction=0.6, seed=seed)
        assert set(first.origin) & set(second.origin) == set()
        assert len(set(first.origin)) == 3 and len(first) + len(second) == len(windows)


def test_a_split_by_condition_shares_no_condition():
    data = data_of(3, 4, 5, 6, 7, conditions=["a", "b", "a", "c", "b"])

    first, second = data.split(fraction=0.5, by="condition")

    assert set(first.conditions) & set(second.conditions) == set()
    assert sorted(first.conditions + second.conditions) == ["a", "a", "b", "b", "c"]


def test_a_split_depends_on_the_seed_alone():
    data = data_of(*range(1, 9))

    assert_same(data.split(seed=1)[0], data.split(seed=1)[0])
    assert len({tuple(data.split(fraction=0.5, seed=s)[0].origin) for s in range(10)}) > 1


def test_each_part_of_a_split_gets_something():
    for fraction in (0.01, 0.99):
        first, second = data_of(3, 4, 5).split(fraction=fraction)
        assert len(first) >= 1 and len(second) >= 1
    with pytest.raises(TrajectoryError, match="A split by condition needs at least two of them"):
        data_of(3, 4).split(by="condition")
    with pytest.raises(TrajectoryError, match="split takes a fraction between 0 and 1"):
        data_of(3, 4).split(fraction=1.0)


def test_concatenation_keeps_recordings_apart():
    one, other = data_of(3, 4, conditions="a"), data_of(6, conditions="b", seed=1)

    joined = Trajectories.concatenate([one, other])

    assert joined.lengths.tolist() == [3, 4, 6]
    assert (joined.conditions, joined.origin.tolist()) == (("a", "a", "b"), [0, 1, 2])
    np.testing.assert_array_equal(joined.episode(2)[0], other.episode(0)[0])
    with pytest.raises(TrajectoryError, match=re.escape("Resample first: part.resample(dt=0.1)")):
        Trajectories.concatenate([one, data_of(3, dt=0.2)])
    with pytest.raises(TrajectoryError, match="same channels"):
        Trajectories.concatenate([one, data_of(3, n_obs=3)])


# --- resampling


def test_upsampling_interpolates_observations_and_holds_actions():
    data = Trajectories.from_arrays(
        obs=[[[0.0], [1.0], [3.0]]], actions=[[[5.0], [7.0]]], dt=0.1, conditions=["a"]
    )

    fine = data.resample(dt=0.05)

    # The grid points are dyadic fractions, but 0.1 / 0.05 rounds.
    np.testing.assert_allclose(fine.obs[0, :, 0], [0.0, 0.5, 1.0, 2.0, 3.0], atol=1e-12)
    assert fine.actions[0, :, 0].tolist() == [5.0, 5.0, 7.0, 7.0]
    assert (fine.dt, fine.conditions) == (0.05, ("a",))


def test_downsampling_by_an_integer_keeps_samples_exactly_and_drops_the_rest():
    data = data_of(7, 9)

    coarse = data.resample(dt=0.3)

    assert coarse.lengths.tolist() == [2, 3]
    np.testing.assert_array_equal(coarse.episode(1)[0], data.episode(1)[0][::3])
    np.testing.assert_array_equal(coarse.episode(1)[1], data.episode(1)[1][::3])
    # 0.07 / 0.01 is a little more than 7.
    assert data_of(7, dt=0.01).resample(dt=0.07).lengths.tolist() == [1]


def test_a_straight_line_survives_any_ratio():
    time = 0.1 * np.arange(11)[:, None]
    data = Trajectories.from_arrays(obs=[time], actions=[time[:-1]], dt=0.1)

    odd = data.resample(dt=0.07)

    assert odd.lengths.tolist() == [14]  # 14 * 0.07 s = 0.98 s of 1 s
    # Linear interpolation of a line is exact up to rounding.
    np.testing.assert_allclose(odd.obs[0, :, 0], 0.07 * np.arange(15), atol=1e-12)
    np.testing.assert_allclose(
        odd.actions[0, :, 0], 0.1 * np.floor(0.7 * np.arange(14)), atol=1e-12
    )


def test_there_and_back_is_the_same_data():
    data = data_of(5, 8)

    back = data.resample(dt=0.02).resample(dt=0.1)

    np.testing.assert_allclose(back.obs, data.obs, atol=1e-12)  # rounding of the grid
    np.testing.assert_array_equal(back.actions, data.actions)
    assert data.resample(dt=0.1) is data


def test_an_angle_turns_the_shorter_way_across_the_seam():
    data = Trajectories.from_arrays(obs=[[[3.0, 3.0], [-3.0, -3.0]]], actions=[[[0.0]]], dt=0.1)

    middle = data.resample(dt=0.05, angles=[0]).obs[0, 1]

    assert abs(middle[0]) == pytest.approx(np.pi)  # half way from 3 to 2 pi - 3
    assert middle[1] == pytest.approx(0.0)  # the other column is no angle


def test_a_trajectory_shorter_than_the_new_step_is_refused():
    with pytest.raises(
        TrajectoryError, match=r"Trajectory 1 lasts 0.2 s, less than one step of 0.3"
    ):
        data_of(5, 2).resample(dt=0.3)


# --- files


def test_a_saved_file_comes_back_bit_for_bit(tmp_path):
    data = data_of(3, 9, 5, conditions=["a", "", "c d"]).windows(3)

    # NumPy appends its suffix to any other, and so do we.
    for name in ("run", "run.v2"):
        path = data.save(tmp_path / name)
        assert path == tmp_path / f"{name}.npz"
        assert_same(Trajectories.load(path), data)
        assert_same(Trajectories.load(str(tmp_path / name)), data)
    assert sorted(os.listdir(tmp_path)) == ["run.npz", "run.v2.npz"]
    with pytest.raises(TrajectoryError, match="The folder must exist and be writable"):
        data.save(tmp_path / "nowhere" / "run")


def test_a_damaged_file_is_refused(tmp_path):
    path = data_of(300).save(tmp_path / "run")
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[1000] ^= 1  # inside the compressed observations

    for content in (flipped, *(whole[:n] for n in (0, 100, len(whole) // 2, len(whole) - 1))):
        path.write_bytes(content)
        with pytest.raises(TrajectoryError, match="is damaged or was not written by"):
            Trajectories.load(path)


def test_foreign_files_are_refused_with_what_they_hold(tmp_path):
    np.savez(tmp_path / "other.npz", states=np.zeros(3), torque=np.zeros(3))
    np.savez(tmp_path / "objects.npz", obs=np.array([None, {}]))
    np.save(tmp_path / "array.npy", np.zeros(3))
    (tmp_path / "array.npy").rename(tmp_path / "array.npz")
    with zipfile.ZipFile(tmp_path / "text.npz", "w") as archive:
        archive.writestr("readme.txt", "hello")
    (tmp_path / "log.csv").write_text("t,q\n")

    for name, says in (
        ("other.npz", "it holds: states, torque"),
        *((f"{kind}.npz", "not written by Trajectories") for kind in ("objects", "array", "text")),
        ("log.csv", "files that end in .npz can"),
        ("missing.npz", "There is no file"),
    ):
        with pytest.raises(TrajectoryError, match=says):
            Trajectories.load(tmp_path / name)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"version": np.array(2)}, r"is of version 2, .* reads up to 1. Upgrade"),
        ({"lengths": np.array([3, 99])}, "does not fit together"),
        ({"conditions": np.array(["one"])}, "does not fit together"),
        ({"origin": np.zeros(3, int)}, "does not fit together"),
        ({"dt": np.array(np.nan)}, "does not fit together"),
    ],
)
def test_a_file_of_a_later_version_or_of_other_parts_is_refused(tmp_path, change, says):
    path = data_of(3, 4).save(tmp_path / "run")
    with np.load(path) as archive:
        content = dict(archive) | change
    np.savez(path, **content)

    with pytest.raises(TrajectoryError, match=says):
        Trajectories.load(path)


def test_a_failed_save_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    old = data_of(3)
    path = old.save(tmp_path / "run")

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(TrajectoryError, match="could not be written: No space left on device"):
        data_of(4).save(path)

    assert os.listdir(tmp_path) == ["run.npz"]
    assert_same(Trajectories.load(path), old)


def test_it_prints_itself_in_80_columns():
    data = data_of(4, 200, 70, conditions=["P8", "P16", "P8"], dt=0.05)

    assert repr(data) == (
        "Trajectories: 3 of 4 to 200 steps, 274 steps or 13.7 s in all at dt = 0.05 s\n"
        "  channels: 2 observed, 1 commanded\n"
        "  conditions: 'P8' (2), 'P16' (1)"
    )
    assert max(map(len, repr(data).splitlines())) <= 80


# --- SB3's replay buffer

BOX = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
TORQUE = gym.spaces.Box(np.array([-2.0, 0.0]), np.array([2.0, 10.0]), dtype=np.float64)


def filled(n_steps, size=100, n_envs=1, done_at=(), timeout_at=(), **kwargs):
    """
    A buffer and what was put in. Observations count (environment, step); where an episode ends, the
    step leads to a terminal observation of its own, and the next episode starts 1000 further.
    """
    buffer = ReplayBuffer(size * n_envs, BOX, TORQUE, device="cpu", n_envs=n_envs, **kwargs)
    rng = np.random.default_rng(0)
    envs = np.arange(n_envs, dtype=np.float32)
    now = np.stack([envs, np.zeros_like(envs)], 1)
    transitions = []
    for k in range(n_steps):
        done = np.full(n_envs, k in done_at or k in timeout_at)
        after = now + np.array([0.0, 1.0], np.float32)
        action = rng.uniform(-1.0, 1.0, (n_envs, 2)).astype(np.float32)
        infos = [{"TimeLimit.truncated": k in timeout_at}] * n_envs
        buffer.add(now, after, action, np.zeros(n_envs), done, infos)
        transitions.append((now, action, after))
        now = after + np.array([0.0, 1000.0], np.float32) if done[0] else after
    return buffer, transitions


def assert_holds(data, i, transitions, env=0):
    """Trajectory ``i`` is these transitions, its actions in the units of ``TORQUE``."""
    obs, actions = data.episode(i)
    expected = [now[env] for now, _, _ in transitions] + [transitions[-1][2][env]]
    np.testing.assert_array_equal(obs, expected)
    scaled = np.array([action[env] for _, action, _ in transitions], np.float64)
    torque = np.stack([2.0 * scaled[:, 0], 5.0 + 5.0 * scaled[:, 1]], 1)
    np.testing.assert_allclose(actions, torque, rtol=1e-12)  # rounding of one multiplication


def test_episodes_of_a_replay_buffer_end_at_dones_timeouts_and_resets_from_outside():
    buffer, put_in = filled(10, done_at=(3,), timeout_at=(6,))
    elsewhere = np.array([[9.0, 9.0]], np.float32)
    buffer.add(elsewhere, elsewhere + 1, np.zeros((1, 2)), np.zeros(1), np.zeros(1), [{}])

    data = Trajectories.from_replay_buffer(buffer, dt=0.05)

    assert data.lengths.tolist() == [4, 3, 3, 1]
    for i, steps in enumerate((put_in[:4], put_in[4:7], put_in[7:])):
        assert_holds(data, i, steps)
    raw = Trajectories.from_replay_buffer(buffer, dt=0.05, scaled=False)
    np.testing.assert_array_equal(raw.actions[0], [action[0] for _, action, _ in put_in[:4]])


def test_a_full_ring_is_read_oldest_first():
    buffer, put_in = filled(17, size=10, done_at=(11,))

    data = Trajectories.from_replay_buffer(buffer, dt=0.05)

    assert_holds(data, 0, put_in[7:12])
    assert_holds(data, 1, put_in[12:])


def test_environments_are_kept_apart():
    buffer, put_in = filled(6, n_envs=3, done_at=(1,))

    data = Trajectories.from_replay_buffer(buffer, dt=0.05)

    assert data.lengths.tolist() == [2, 4] * 3
    for env in range(3):
        assert_holds(data, 2 * env, put_in[:2], env)
        assert_holds(data, 2 * env + 1, put_in[2:], env)


SHARED = {"optimize_memory_usage": True, "handle_timeout_termination": False}


def test_shared_memory_loses_what_the_last_action_of_an_episode_led_to():
    buffer, put_in = filled(8, done_at=(3, 7), **SHARED)

    data = Trajectories.from_replay_buffer(buffer, dt=0.05)

    assert data.lengths.tolist() == [3, 4]
    assert_holds(data, 0, put_in[:3])
    assert_holds(data, 1, put_in[4:])  # nothing has overwritten the newest yet


def test_shared_memory_loses_the_oldest_step_of_a_full_ring():
    buffer, put_in = filled(17, size=10, done_at=(11,), **SHARED)

    data = Trajectories.from_replay_buffer(buffer, dt=0.05)

    assert_holds(data, 0, put_in[8:11])
    assert_holds(data, 1, put_in[12:])


def test_what_sb3_collected_replays_in_the_environment(tmp_path):
    model = SAC("MlpPolicy", "Pendulum-v1", learning_starts=300, buffer_size=1000, device="cpu")
    model.learn(250)

    data = Trajectories.from_replay_buffer(model.replay_buffer, dt=0.05)

    assert data.lengths.tolist() == [200, 50]
    env = gym.make("Pendulum-v1").unwrapped
    env.reset(seed=0)
    obs, actions = data.episode(0)
    env.state = np.array([np.arctan2(obs[0, 1], obs[0, 0]), obs[0, 2]])
    for k in range(20):
        # Stored actions went through float32 and back, and a swing-up amplifies that little.
        np.testing.assert_allclose(env.step(actions[k])[0], obs[k + 1], atol=1e-4)


IMAGE, CHOICE = gym.spaces.Box(0, 1, (4, 4)), gym.spaces.Discrete(3)


@pytest.mark.parametrize(
    ("spaces", "message"),
    [
        ((BOX, TORQUE), "holds no step yet"),
        ((IMAGE, TORQUE), "buffers of flat Box observations"),
        ((BOX, CHOICE), r"a Box with finite limits, got Discrete\(3\)"),
        ((BOX, gym.spaces.Box(-np.inf, np.inf, (1,))), "a Box with finite limits"),
    ],
)
def test_a_buffer_that_holds_no_trajectories_is_refused(spaces, message):
    with pytest.raises(TrajectoryError, match=message):
        Trajectories.from_replay_buffer(ReplayBuffer(10, *spaces, device="cpu"), dt=0.05)
