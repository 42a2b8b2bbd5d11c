"""Gymnasium's vectorised environments under SB3: what a learner stores is what happened."""

import gymnasium
import numpy as np
import pytest
import sbx
import stable_baselines3
from counting import Counting, CountingVector, Row, length_of, truth
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecNormalize

from sb3_hds import DroQ
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
    rows = [
        [
            Row(
                tuple(buffer.observations[k, i].tolist()),
                float(buffer.actions[k, i, 0]),
                float(buffer.rewards[k, i]),
                tuple(buffer.next_observations[k, i].tolist()),
                bool(buffer.dones[k, i]),
                bool(buffer.timeouts[k, i]),
            )
            for k in range(buffer.pos)
        ]
        for i in range(buffer.n_envs)
    ]
    assert sum(map(len, rows)) == model.num_timesteps
    return rows


def assert_true(rows: list[list[Row]]) -> None:
    for i, found in enumerate(rows):
        assert found == truth(i, np.array([row.action for row in found]))


LEARNERS = {
    "SB3's SAC": lambda env: stable_baselines3.SAC(
        "MlpPolicy", env, learning_starts=10**6, buffer_size=300, seed=0
    ),
    "SBX's SAC": lambda env: sbx.SAC(
        "MlpPolicy", env, learning_starts=10**6, buffer_size=300, seed=0
    ),
    "DroQ": lambda env: DroQ(
        env, learning_starts=10**6, buffer_size=300, seed=0, policy_kwargs={"net_arch": [8]}
    ),
}


@pytest.mark.parametrize(
    ("mode", "learner"),
    [
        *((mode, "SB3's SAC") for mode in MODES),
        (AutoresetMode.NEXT_STEP, "DroQ"),
        pytest.param(AutoresetMode.NEXT_STEP, "SBX's SAC", marks=pytest.mark.expensive),
    ],
)
def test_the_replay_buffer_holds_exactly_the_true_transitions(mode, learner):
    model = LEARNERS[learner](GymnasiumVecEnv(sync(mode)))

    model.learn(40 * N)

    rows = stored(model)
    assert_true(rows)
    # Episodes of several lengths, ended both ways.
    assert {row.cut for copy in rows for row in copy if row.done} == {True, False}
    assert len(model.ep_info_buffer) > 10
    if learner == "SB3's SAC":
        # What is bootstrapped is what was only cut.
        batch = model.replay_buffer._get_samples(np.arange(model.replay_buffer.pos))
        for obs, over in zip(batch.observations.numpy(), batch.dones, strict=True):
            copy, episode, step, _ = obs
            last = step + 1 == length_of(copy, episode)
            assert bool(over) == (last and (copy + episode) % 2 == 1)


@pytest.mark.parametrize(
    "mode",
    [
        AutoresetMode.NEXT_STEP,
        pytest.param(AutoresetMode.SAME_STEP, marks=pytest.mark.expensive),
        pytest.param(AutoresetMode.DISABLED, marks=pytest.mark.expensive),
    ],
)
def test_environments_in_other_processes_are_stored_as_truly(mode):
    env = GymnasiumVecEnv(
        AsyncVectorEnv([counting(i) for i in range(2)], autoreset_mode=mode, context="forkserver")
    )
    try:
        model = LEARNERS["SB3's SAC"](env).learn(2 * 20)
        assert_true(stored(model))
        assert env.get_attr("copy") == [0, 1] and env.get_attr("copy", 1) == [1]
        assert env.env_method("painted", "blue") == ["blue 0", "blue 1"]
        with pytest.raises(NotImplementedError, match="all copies or none"):
            env.env_method("painted", "blue", indices=0)
        env.set_attr("colour", "green", indices=[1])
        assert env.get_attr("colour") == ["red", "green"]
    finally:
        env.close()


def test_somebodys_own_environment_is_stored_as_truly():
    own = CountingVector(N, AutoresetMode.NEXT_STEP, knows_masks=True)
    envs = [
        GymnasiumVecEnv(CountingVector(N, AutoresetMode.SAME_STEP, "final_obs")),
        GymnasiumVecEnv(CountingVector(N, AutoresetMode.SAME_STEP, "final_observation")),
        GymnasiumVecEnv(CountingVector(N, AutoresetMode.DISABLED)),
        GymnasiumVecEnv(own, partial_reset=lambda which: own.reset(options={"reset_mask": which})),
    ]

    for env in envs:
        assert_true(stored(LEARNERS["SB3's SAC"](env).learn(40 * N)))


def test_steps_that_are_no_transitions_are_refused_at_the_door():
    with pytest.raises(ParameterError, match="That step is no transition"):
        GymnasiumVecEnv(CountingVector(N, AutoresetMode.NEXT_STEP))
    with pytest.raises(ParameterError, match="That step is no transition"):
        GymnasiumVecEnv(gymnasium.make_vec("CartPole-v1", 2, "vector_entry_point"))
    silent = CountingVector(N, AutoresetMode.SAME_STEP)
    silent.metadata = {}
    with pytest.raises(ParameterError, match="does not say how it resets"):
        GymnasiumVecEnv(silent)
    assert GymnasiumVecEnv(silent, autoreset_mode="SameStep").num_envs == N
    with pytest.raises(ParameterError, match=r"takes a gymnasium\.vector\.VectorEnv"):
        GymnasiumVecEnv(Counting())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (CountingVector(N, AutoresetMode.SAME_STEP, None), "no 'final_obs'"),
        (CountingVector(N, AutoresetMode.DISABLED, knows_masks=False), "others changed as well"),
    ],
)
def test_an_environment_that_does_not_keep_to_its_mode_is_found_when_it_ends(env, message):
    adapted = GymnasiumVecEnv(env)
    adapted.reset()

    with pytest.raises(RuntimeError, match=message):
        for _ in range(10):
            adapted.step(np.zeros((N, 1), np.float32))


@every_mode
def test_episodes_are_told_as_monitor_tells_them(mode):
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


def test_returns_are_evaluated():
    env = GymnasiumVecEnv(sync(AutoresetMode.SAME_STEP))
    env.seed(0)

    model = LEARNERS["SB3's SAC"](env)
    _, lengths = evaluate_policy(model, env, 3, return_episode_rewards=True, warn=True)

    assert sorted(lengths) == sorted(length_of(copy, 0) for copy in range(N))


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
    env = GymnasiumVecEnv(
        SyncVectorEnv([lambda: gymnasium.wrappers.TimeLimit(Counting(4), 9), counting(5)])
    )

    assert env.get_attr("copy") == [4, 5] and env.get_attr("copy", [1]) == [5]
    assert env.env_method("painted", "blue", indices=1) == ["blue 5"]
    env.set_attr("colour", "green", indices=0)
    assert env.get_attr("colour") == ["green", "red"]
    assert env.env_is_wrapped(gymnasium.wrappers.TimeLimit) == [True, False]
    assert env.has_attr("colour") and not env.has_attr("smell")
    with pytest.raises(AttributeError, match="no environments of their own"):
        GymnasiumVecEnv(CountingVector(N, AutoresetMode.DISABLED)).env_method("painted", "blue")


def test_closing_closes_and_images_are_those_of_the_copies():
    vector = SyncVectorEnv([lambda: Counting(1, "rgb_array"), lambda: Counting(2, "rgb_array")])
    env = GymnasiumVecEnv(vector)

    images = env.get_images()
    env.close()

    assert [image.max() for image in images] == [1, 2] and vector.closed
    assert env.render_mode == "rgb_array"
    with pytest.warns(UserWarning, match="no images"):
        assert GymnasiumVecEnv(sync(AutoresetMode.NEXT_STEP)).get_images() == [None] * N


@every_mode
def test_dictionaries_and_choices_are_taken_apart(mode):
    class Choosing(gymnasium.Env):
        observation_space = gymnasium.spaces.Dict(
            {"at": gymnasium.spaces.Box(0.0, 9.0, (1,)), "which": gymnasium.spaces.Discrete(9)}
        )
        action_space = gymnasium.spaces.Discrete(3)

        def reset(self, *, seed=None, options=None):
            self.now = 0
            return self._obs(), {}

        def step(self, action):
            self.now += 1
            return self._obs(), float(action), False, self.now == 3, {}

        def _obs(self):
            return {"at": np.array([self.now], np.float32), "which": self.now}

    env = GymnasiumVecEnv(SyncVectorEnv([Choosing, Choosing], autoreset_mode=mode))
    env.reset()
    for _ in range(3):
        obs, rewards, dones, infos = env.step(np.array([2, 1]))

    assert dones.all() and rewards.tolist() == [2.0, 1.0]
    np.testing.assert_array_equal(obs["at"], [[0.0], [0.0]])
    np.testing.assert_array_equal(obs["which"], [0, 0])
    for info in infos:
        assert info["TimeLimit.truncated"] and info["terminal_observation"]["which"] == 3
        np.testing.assert_array_equal(info["terminal_observation"]["at"], [3.0])


def test_normalisation_of_sb3_stands_on_top():
    env = VecNormalize(GymnasiumVecEnv(gymnasium.make_vec("Pendulum-v1", 2, "sync")))
    env.reset()

    for _ in range(200):
        obs, _, dones, infos = env.step(np.zeros((2, 1), np.float32))

    assert dones.all() and all(info["TimeLimit.truncated"] for info in infos)
    last = env.unnormalize_obs(infos[0]["terminal_observation"])
    assert np.hypot(last[0], last[1]) == pytest.approx(1.0, abs=1e-3)
    assert obs.shape == (2, 3)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_statistics_that_begin_anew_in_all_copies_are_not_those_that_are_logged(mode):
    counted = gymnasium.wrappers.vector.RecordEpisodeStatistics(sync(mode))
    with_theirs, with_ours = GymnasiumVecEnv(counted), GymnasiumVecEnv(sync(mode))
    with_theirs.reset(), with_ours.reset()

    for _ in range(30):
        _, _, dones, infos = with_theirs.step(np.zeros((N, 1), np.float32))
        expected = with_ours.step(np.zeros((N, 1), np.float32))[3]
        for i in np.flatnonzero(dones):
            assert infos[i]["episode"]["l"] == expected[i]["episode"]["l"]
            assert infos[i]["episode"]["r"] == pytest.approx(expected[i]["episode"]["r"])
