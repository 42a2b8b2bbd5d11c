"""Measured data: checked at the door, padded, cut, split, resampled, saved."""

import io
import os
import re

import gymnasium as gym
import jax
import numpy as np
import pytest
from cases import each
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
    # Conditions are one for each, or one for all.
    assert data.conditions == ("default",) * 3
    assert data_of(3, 4, conditions="heavy").conditions == ("heavy", "heavy")
    assert data_of(3, 4, conditions=[0.5, "light"]).conditions == ("0.5", "light")


def spoilt(obs, value):
    obs[1][2, 1] = obs[1][4, 0] = value
    return obs


@each(
    (lambda obs, u: (obs, [u[0][:-1], u[1]]), "obs[0] must have one row more than actions[0]"),
    (lambda obs, u: ([x[1:] for x in obs], u), "drop that one: actions=[a[:-1] for a"),
    (lambda obs, u: (u, obs), "Are obs and actions swapped?"),
    (lambda obs, u: ([obs[0][:1], obs[1]], [u[0][:0], u[1]]), "must be at least one action"),
    (lambda obs, u: (obs[0], u[0]), "obs[0] must have shape (T + 1, n_obs), got (2,)"),
    (lambda obs, u: (obs, u[:1]), "one array per trajectory, got 2 in obs and 1 in actions."),
    (lambda obs, u: ([obs[0], obs[1][:, :1]], u), "All trajectories must have the same chan"),
    (lambda obs, u: (obs, [u[0], u[1].astype(str)]), "actions[1] must be an array of real"),
    (lambda obs, u: ([[[1.0, 2.0], [3.0]], obs[1]], u), "obs[0] must be an array of real"),
    (lambda obs, u: (spoilt(obs, np.nan), u), "got nan at row 2, column 1 (2 such values"),
)
def test_arrays_that_are_no_trajectories_are_refused_with_the_way_out(change, message):
    obs, actions = change(*recording(3, 5))
    with pytest.raises(TrajectoryError, match=re.escape(message)):
        Trajectories.from_arrays(obs=obs, actions=actions, dt=0.1)


def test_parts_that_do_not_fit_together_are_refused():
    data = data_of(3, 4)
    rest = (0.1, ("a", "b"), data.origin)
    hole = data.mask.copy()
    hole[1, 1] = False

    for make, says in (
        (lambda: Trajectories(data.obs[:, 1:], data.actions, data.mask, *rest), "do not fit"),
        (lambda: Trajectories(data.obs, data.actions, hole, *rest), "mask must be True for the"),
        (lambda: data_of(3, dt=0.0), "interval in seconds, .* got 0.0"),
        (lambda: data_of(3, 4, conditions=["heavy"]), "one label per trajectory, got 1 for 2"),
        (lambda: data_of(10).windows(11), "No trajectory has 11 steps; the longest has 10"),
        (lambda: data.split(by="condition"), "A split by condition needs at least two of them"),
        (lambda: data.split(fraction=1.0), "split takes a fraction between 0 and 1"),
        (lambda: data_of(5, 2).resample(dt=0.3), "1 lasts 0.2 s, less than one step of 0.3"),
        (lambda: Trajectories.concatenate([data, data_of(3, dt=0.2)]), "Resample first: part.res"),
        (lambda: Trajectories.concatenate([data, data_of(3, n_obs=3)]), "same channels"),
    ):
        with pytest.raises(TrajectoryError, match=says):
            make()


def test_indexing_gives_trajectories_padded_no_longer_than_needed():
    data = data_of(3, 7, 5, conditions=["a", "b", "c"])

    one, some, rest = data[-1], data[np.array([2, 0])], data[1:]

    assert (len(one), one.actions.shape, one.conditions) == (1, (1, 5, 1), ("c",))
    assert (some.conditions, some.origin.tolist()) == (("c", "a"), [2, 0])
    np.testing.assert_array_equal(some.episode(1)[0], data.episode(0)[0])
    assert rest.lengths.tolist() == [7, 5]
    assert_same(data[data.lengths > 4], rest)
    joined = Trajectories.concatenate([data, data_of(6, conditions="d", seed=1)])
    assert (joined.lengths.tolist(), joined.origin.tolist()) == ([3, 7, 5, 6], [0, 1, 2, 3])
    assert joined.conditions == ("a", "b", "c", "d")
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
    expected = data.obs.sum((1, 2)) + data.actions.sum((1, 2))
    np.testing.assert_allclose(sums, expected, rtol=1e-5, atol=1e-5)
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(data)]
    assert paths == [".obs", ".actions", ".mask", ".origin"]


def test_windows_lie_inside_real_data_and_know_where_they_are_from():
    data = data_of(3, 8, 2, conditions=["a", "b", "c"])

    windows = data.windows(3, stride=2)

    assert windows.origin.tolist() == [0, 1, 1, 1] and windows.conditions == ("a", "b", "b", "b")
    assert windows.mask.all() and windows.actions.shape == (4, 3, 1)
    for window, start in ((1, 0), (2, 2), (3, 4)):
        np.testing.assert_array_equal(windows.obs[window], data.obs[1, start : start + 4])
        np.testing.assert_array_equal(windows.actions[window], data.actions[1, start : start + 3])
    # They do not overlap unless asked.
    assert len(data_of(10).windows(3)) == 3
    assert data_of(8, 12).windows(4)[2:].windows(2).origin.tolist() == [1] * 6


def test_a_split_shares_no_recording_or_no_condition_and_depends_on_the_seed_alone():
    windows = data_of(9, 9, 9, 9, 9, conditions=["a", "b", "a", "c", "b"]).windows(3, stride=1)

    splits = [windows.split(fraction=0.6, seed=seed) for seed in range(5)]
    light, heavy = windows.split(fraction=0.5, by="condition")

    for first, second in splits:
        assert set(first.origin) & set(second.origin) == set()
        assert len(set(first.origin)) == 3 and len(first) + len(second) == len(windows)
    assert len({tuple(first.origin) for first, _ in splits}) > 1
    assert_same(splits[1][0], windows.split(fraction=0.6, seed=1)[0])
    assert set(light.conditions) & set(heavy.conditions) == set()
    assert len(light) + len(heavy) == len(windows)
    for fraction in (0.01, 0.99):
        assert min(map(len, windows.split(fraction=fraction))) >= 1


def test_upsampling_interpolates_observations_and_holds_actions():
    obs, actions = [[[0.0], [1.0], [3.0]]], [[[5.0], [7.0]]]
    data = Trajectories.from_arrays(obs=obs, actions=actions, dt=0.1, conditions=["a"])

    fine, odd = data.resample(dt=0.05), data.resample(dt=0.06)

    # The grid points are dyadic fractions, but 0.1 / 0.05 rounds.
    np.testing.assert_allclose(fine.obs[0, :, 0], [0.0, 0.5, 1.0, 2.0, 3.0], atol=1e-12)
    assert fine.actions[0, :, 0].tolist() == [5.0, 5.0, 7.0, 7.0]
    np.testing.assert_allclose(odd.obs[0, :, 0], [0.0, 0.6, 1.4, 2.6], atol=1e-12)
    assert odd.actions[0, :, 0].tolist() == [5.0, 5.0, 7.0]
    assert (fine.dt, fine.conditions) == (0.05, ("a",)) and data.resample(dt=0.1) is data


def test_downsampling_by_an_integer_keeps_samples_exactly_and_drops_the_rest():
    data = data_of(7, 9)

    coarse = data.resample(dt=0.3)

    assert coarse.lengths.tolist() == [2, 3]
    np.testing.assert_array_equal(coarse.episode(1)[0], data.episode(1)[0][::3])
    np.testing.assert_array_equal(coarse.episode(1)[1], data.episode(1)[1][::3])
    # 0.07 / 0.01 is a little more than 7.
    assert data_of(7, dt=0.01).resample(dt=0.07).lengths.tolist() == [1]


def test_an_angle_turns_the_shorter_way_across_the_seam():
    data = Trajectories.from_arrays(obs=[[[3.0, 3.0], [-3.0, -3.0]]], actions=[[[0.0]]], dt=0.1)
    middle = data.resample(dt=0.05, angles=[0]).obs[0, 1]
    assert abs(middle[0]) == pytest.approx(np.pi)  # half way from 3 to 2 pi - 3
    assert middle[1] == pytest.approx(0.0)  # the other column is no angle


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


def packed(**arrays):
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def test_a_file_that_is_damaged_or_not_ours_is_refused_with_what_it_holds(tmp_path):
    path = data_of(300).save(tmp_path / "run")
    whole, flipped = path.read_bytes(), bytearray(path.read_bytes())
    flipped[1000] ^= 1  # inside the compressed observations
    with np.load(path) as archive:
        own = dict(archive)

    for content, says in (
        (flipped, "is damaged or was not written by"),
        *((whole[:n], "is damaged") for n in (0, 100, len(whole) // 2, len(whole) - 1)),
        (packed(states=np.zeros(3), torque=np.zeros(3)), "it holds: states, torque"),
        (packed(obs=np.array([None, {}])), "not written by Trajectories"),
        (packed(**own | {"version": np.array(2)}), r"is of version 2, .* reads up to 1\. Upgrade"),
        (packed(**own | {"lengths": np.array([999])}), "does not fit together"),
        (packed(**own | {"origin": np.zeros(3, int)}), "does not fit together"),
        (packed(**own | {"dt": np.array(np.nan)}), "does not fit together"),
    ):
        path.write_bytes(content)
        with pytest.raises(TrajectoryError, match=says):
            Trajectories.load(path)
    with pytest.raises(TrajectoryError, match="There is no file"):
        Trajectories.load(tmp_path / "missing.npz")


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


BOX = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
TORQUE = gym.spaces.Box(np.array([-2.0, 0.0]), np.array([2.0, 10.0]), dtype=np.float64)


def filled(n_steps, size=100, n_envs=1, done_at=(), timeout_at=(), **kwargs):
    """A buffer of (environment, step), whose next episodes start 1000 further."""
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


# With shared memory, what the last action of an episode led to is lost, and the oldest of a ring.
SHARED = {"optimize_memory_usage": True, "handle_timeout_termination": False}


@each(
    (17, {"size": 10, "done_at": (11,)}, [(7, 12), (12, 17)]),
    (6, {"n_envs": 3, "done_at": (1,)}, [(0, 2), (2, 6)]),
    # Nothing has overwritten the newest yet.
    (8, {"done_at": (3, 7)} | SHARED, [(0, 3), (4, 8)]),
    (17, {"size": 10, "done_at": (11,)} | SHARED, [(8, 11), (12, 17)]),
    ids=["full ring", "several environments", "shared memory", "shared memory, full ring"],
)
def test_a_replay_buffer_is_read_oldest_first_and_by_environment(n_steps, more, steps):
    buffer, put_in = filled(n_steps, **more)

    data = Trajectories.from_replay_buffer(buffer, dt=0.05)

    assert len(data) == len(steps) * more.get("n_envs", 1)
    for i in range(len(data)):
        env, (first, last) = i // len(steps), steps[i % len(steps)]
        assert_holds(data, i, put_in[first:last], env)


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


@each(
    ((BOX, TORQUE), "holds no step yet"),
    ((IMAGE, TORQUE), "buffers of flat Box observations"),
    ((BOX, CHOICE), r"a Box with finite limits, got Discrete\(3\)"),
    ((BOX, gym.spaces.Box(-np.inf, np.inf, (1,))), "a Box with finite limits"),
)
def test_a_buffer_that_holds_no_trajectories_is_refused(spaces, message):
    with pytest.raises(TrajectoryError, match=message):
        Trajectories.from_replay_buffer(ReplayBuffer(10, *spaces, device="cpu"), dt=0.05)
