"""Gymnasium's vectorised environments under SB3: what a learner stores is what happened."""

import gymnasium
import numpy as np
import pytest
import stable_baselines3
from cases import each
from counting import Counting, CountingVector, Row, length_of, truth
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TransformAction, TransformObservation
from stable_baselines3.common.monitor import Monitor

from sb3_hds.errors import ParameterError
from sb3_hds.wrappers import GymnasiumVecEnv

MODES = list(AutoresetMode)
every_mode = pytest.mark.parametrize("mode", MODES, ids=[mode.name for mode in MODES])
N = 3


def counting(i: int):
    return lambda: Counting(i)


def sync(mode: AutoresetMode, n: int = N) -> SyncVectorEnv:
    return SyncVectorEnv([counting(i) for i in range(n)], autoreset_mode=mode)


def stored(model) -> list[list[Row]]:
    """:return: what the replay buffer holds, of each copy, in the order in which it came"""
    buffer = model.replay_buffer

    def row(k, i):
        seen, after = (x[k, i].tolist() for x in (buffer.observations, buffer.next_observations))
        done, cut = bool(buffer.dones[k, i]), bool(buffer.timeouts[k, i])
        action, reward = float(buffer.actions[k, i, 0]), float(buffer.rewards[k, i])
        return Row(tuple(seen), action, reward, tuple(after), done, cut)

    rows = [[row(k, i) for k in range(buffer.pos)] for i in range(buffer.n_envs)]
    assert sum(map(len, rows)) == model.num_timesteps
    return rows


def assert_true(rows: list[list[Row]]) -> None:
    for i, found in enumerate(rows):
        assert found == truth(i, np.array([row.action for row in found]))


def learned(env, n_steps=40 * N):
    model = stable_baselines3.SAC("MlpPolicy", env, learning_starts=10**6, buffer_size=300, seed=0)
    return model.learn(n_steps)


@every_mode
def test_the_replay_buffer_holds_exactly_the_true_transitions(mode):
    model = learned(GymnasiumVecEnv(sync(mode)))

    rows = stored(model)
    assert_true(rows)
    # Episodes of several lengths, ended both ways.
    assert {row.cut for copy in rows for row in copy if row.done} == {True, False}
    assert len(model.ep_info_buffer) > 10
    # What is bootstrapped is what was only cut.
    batch = model.replay_buffer._get_samples(np.arange(model.replay_buffer.pos))
    for obs, over in zip(batch.observations.numpy(), batch.dones, strict=True):
        copy, episode, step, _ = obs
        last = step + 1 == length_of(copy, episode)
        assert bool(over) == (last and (copy + episode) % 2 == 1)


def test_environments_in_other_processes_are_stored_as_truly():
    env = GymnasiumVecEnv(AsyncVectorEnv([counting(i) for i in range(2)], context="forkserver"))
    try:
        assert_true(stored(learned(env, 2 * 20)))
        assert env.get_attr("copy", 1) == [1]
        assert env.env_method("painted", "blue") == ["blue 0", "blue 1"]
        with pytest.raises(NotImplementedError, match="all copies or none"):
            env.env_method("painted", "blue", indices=0)
        env.set_attr("colour", "green", indices=[1])
        assert env.get_attr("colour") == ["red", "green"]
    finally:
        env.close()


def test_transitions_of_a_users_own_vector_env_are_stored_correctly():
    own = CountingVector(N, AutoresetMode.NEXT_STEP, knows_masks=True)
    envs = [
        GymnasiumVecEnv(CountingVector(N, AutoresetMode.SAME_STEP, "final_obs")),
        GymnasiumVecEnv(CountingVector(N, AutoresetMode.SAME_STEP, "final_observation")),
        GymnasiumVecEnv(CountingVector(N, AutoresetMode.DISABLED)),
        GymnasiumVecEnv(own, partial_reset=lambda which: own.reset(options={"reset_mask": which})),
    ]

    for env in envs:
        assert_true(stored(learned(env)))


def test_steps_that_are_no_transitions_are_refused_at_the_door():
    silent = CountingVector(N, AutoresetMode.SAME_STEP)
    silent.metadata = {}
    for env, says in (
        (CountingVector(N, AutoresetMode.NEXT_STEP), "That step is no transition"),
        (gymnasium.make_vec("CartPole-v1", 2, "vector_entry_point"), "That step is no transition"),
        (silent, "does not declare how it resets"),
        (Counting(), r"takes a gymnasium\.vector\.VectorEnv"),
    ):
        with pytest.raises(ParameterError, match=says):
            GymnasiumVecEnv(env)
    assert GymnasiumVecEnv(silent, autoreset_mode="SameStep").num_envs == N


@each(
    (CountingVector(N, AutoresetMode.SAME_STEP, None), "no 'final_obs'"),
    (CountingVector(N, AutoresetMode.DISABLED, knows_masks=False), "others changed as well"),
)
def test_an_environment_that_does_not_keep_to_its_mode_is_found_when_it_ends(env, message):
    adapted = GymnasiumVecEnv(env)
    adapted.reset()

    with pytest.raises(RuntimeError, match=message):
        for _ in range(10):
            adapted.step(np.zeros((N, 1), np.float32))


@every_mode
def test_episodes_are_reported_as_by_monitor(mode):
    env = GymnasiumVecEnv(sync(mode, 1))
    monitored = Monitor(Counting(0))
    env.reset(), monitored.reset()

    for _ in range(20):
        _, _, [done], [info] = env.step(np.zeros((1, 1), np.float32))
        expected = monitored.step(np.zeros(1, np.float32))[4]
        assert ("episode" in info) == ("episode" in expected) == done
        assert info["step"] == expected["step"]
        if done:
            assert [info["episode"][k] for k in "rl"] == [expected["episode"][k] for k in "rl"]
            assert env.reset_infos[0]["begun"] == monitored.reset()[1]["begun"]


def test_a_failure_in_the_last_step_of_a_limit_is_no_time_out():
    class Failing(Counting):
        def step(self, action):
            obs, reward, *_, info = super().step(action)
            return obs, reward, True, True, info

    env = GymnasiumVecEnv(SyncVectorEnv([lambda: Failing(0)]))
    env.reset()

    _, _, [done], [info] = env.step(np.zeros((1, 1), np.float32))

    assert done and not info["TimeLimit.truncated"]


def test_seeds_and_options_arrive_once():
    env = GymnasiumVecEnv(sync(AutoresetMode.NEXT_STEP))
    env.seed(7)
    env.set_options({"wind": 1.0})

    env.reset()
    assert [info["seed"] for info in env.reset_infos] == [7, 8, 9]
    assert [info["options"] for info in env.reset_infos] == [{"wind": 1.0}] * N
    env.reset()
    assert all("seed" not in info or info["seed"] is None for info in env.reset_infos)

    env.set_options([{"wind": 1.0}, {}, {}])
    with pytest.raises(ParameterError, match="same options"):
        env.reset()


def test_copies_can_be_reached():
    vector = SyncVectorEnv([lambda: gymnasium.wrappers.TimeLimit(Counting(4), 9), counting(5)])
    env = GymnasiumVecEnv(vector)

    assert env.get_attr("copy") == [4, 5] and env.get_attr("copy", [1]) == [5]
    assert env.env_method("painted", "blue", indices=1) == ["blue 5"]
    env.set_attr("colour", "green", indices=0)
    assert env.get_attr("colour") == ["green", "red"]
    assert env.env_is_wrapped(gymnasium.wrappers.TimeLimit) == [True, False]
    assert env.has_attr("colour") and not env.has_attr("smell")
    env.close()
    assert vector.closed
    with pytest.raises(AttributeError, match="no environments of their own"):
        GymnasiumVecEnv(CountingVector(N, AutoresetMode.DISABLED)).env_method("painted", "blue")
    env = GymnasiumVecEnv(SyncVectorEnv([lambda i=i: Counting(i, "rgb_array") for i in (1, 2)]))
    assert [image.max() for image in env.get_images()] == [1, 2]
    with pytest.warns(UserWarning, match="no images"):
        assert GymnasiumVecEnv(sync(AutoresetMode.NEXT_STEP)).get_images() == [None] * N


@every_mode
def test_dictionaries_and_discrete_spaces_are_split(mode):
    space = spaces.Dict(told=spaces.Box(-1.0, 9.0, (1,)), step=spaces.Discrete(9))

    def choosing():
        env = TransformAction(Counting(1), lambda u: np.array([u], np.float32), spaces.Discrete(3))
        return TransformObservation(env, lambda o: {"told": o[3:], "step": int(o[2])}, space)

    env = GymnasiumVecEnv(SyncVectorEnv([choosing] * 2, autoreset_mode=mode))
    env.reset()
    for _ in range(length_of(1, 0)):
        obs, _, dones, infos = env.step(np.array([2, 1]))

    assert dones.all() and obs["step"].tolist() == [0, 0] and obs["told"].tolist() == [[0], [0]]
    ends = [info["terminal_observation"] for info in infos]
    assert [(end["step"], *end["told"]) for end in ends] == [(3, 2.0), (3, 1.0)]
