"""What a time limit does to values, in closed form and as they are learned."""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from free_mass import Mass
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.buffers import NStepReplayBuffer

from sb3_hds import algos
from sb3_hds.algos import learn_compiled
from sb3_hds.algos.model_free.replay import batches_of
from sb3_hds.algos.model_free.sac.update import q_values
from sb3_hds.core import State
from sb3_hds.envs import ConstantReward, TwinEnv
from sb3_hds.errors import ParameterError
from sb3_hds.wrappers import TruncateToTerminate

GAMMA = 0.98
#: 1 / (1 - gamma), and the sum of gamma^k over the four steps of an episode: 50 and 3.88
TRUNCATED = 1.0 / (1.0 - GAMMA)
TERMINATED = (1.0 - GAMMA**4) / (1.0 - GAMMA)

# No bonus for entropy, or values would not be those of the reward. All actions are drawn from the
# whole range: a critic guesses too much where none was tried, and the actor finds that place
# (values ended at 50 to 59 with 50 such steps, at 49.5 to 50.5 with 200).
SETTINGS = {"gamma": GAMMA, "learning_starts": 200, "gradient_steps": 0, "buffer_size": 400}
SETTINGS |= {"train_freq": 1, "seed": 0, "ent_coef": 1e-6, "tau": 0.1, "learning_rate": 1e-2}
SETTINGS |= {"policy_delay": 10, "policy_kwargs": {"net_arch": [32]}}


def value_of(model: Any, obs: np.ndarray) -> float:
    """:return: what the critics think of a state and the middle action, in the mean"""
    policy = model.policy
    flat = np.asarray(policy.flatten(np.asarray(obs)[None]))
    weights, action = policy.agent_state.critic.weights, np.zeros((1, policy.n_act), np.float32)
    return float(
        np.mean(q_values(policy.update_config, weights, flat, action, jax.random.key(0))[0])
    )


@pytest.mark.parametrize("ends", [False, True], ids=["truncated", "terminated"])
def test_a_state_is_worth_what_follows_a_time_limit_unless_that_is_an_end(ends):
    env = gymnasium.make("sb3_hds/ConstantReward-v0")
    env = TruncateToTerminate(env) if ends else env
    model = algos.GSDESAC(env=env, **SETTINGS).learn(200)

    model.train(2500, 32)

    assert pytest.approx((50.0, 3.88), abs=5e-3) == (TRUNCATED, TERMINATED)
    expected = TERMINATED if ends else TRUNCATED
    assert value_of(model, env.reset()[0]) == pytest.approx(expected, rel=0.05)


class Clock(Mass):
    """The example's twin: a hand that goes round in four steps, which ends a heavy one."""

    name = "Clock"

    def initial(self, key, params):
        return State(jnp.zeros(1), jnp.full(1, 5.0 * jnp.pi), {})

    def infer(self, obs, params):
        return State(jnp.arctan2(obs[1:], obs[:1]), jnp.full(1, 5.0 * jnp.pi, obs.dtype), {})

    def observe(self, state, params):
        return jnp.concatenate([jnp.cos(state.q), jnp.sin(state.q)])

    def actuate(self, state, action, params):
        return 0.0 * action

    def reward(self, state, action, next_state, params):
        return jnp.ones(())

    def terminated(self, state, params):
        return (params["mass"] > 1.5) & (state.q[0] > 1.9 * jnp.pi)


@each((1.0, TRUNCATED), (2.0, TERMINATED), ids=["truncated", "terminated"])
def test_what_learns_within_one_program_takes_a_time_limit_for_what_it_is(mass, expected):
    env = TimeLimit(TwinEnv(Clock(mass=mass)), 4)
    # 2500 updates, in the last 200 of 400 steps.
    model = algos.GSDESAC(env=env, **(SETTINGS | {"gradient_steps": 12, "batch_size": 32}))

    (learned,), (episodes,) = learn_compiled(model, 400)

    assert episodes.timesteps.tolist() == list(range(4, 401, 4))
    assert value_of(learned, env.reset()[0]) == pytest.approx(expected, rel=0.05)


def test_the_example_is_a_clock_that_pays_the_same_for_ever():
    env = gymnasium.make("sb3_hds/ConstantReward-v0")
    start, _ = env.reset(seed=0)

    steps = [env.step(env.action_space.sample()) for _ in range(4)]

    assert [step[1:4] for step in steps] == [(1.0, False, k == 3) for k in range(4)]
    np.testing.assert_allclose(steps[0][0], [0.0, 1.0], atol=1e-6)
    # Round once: the last observation is one that is learned about.
    np.testing.assert_array_equal(steps[3][0], start)
    for arguments in ({"period": 0}, {"reward": np.inf}, {"period": 2.5}):
        with pytest.raises(ParameterError, match=next(iter(arguments))):
            ConstantReward(**arguments)


class Ramp(gymnasium.Env):
    """Pays 1, 2, ..., 5, and then ends or begins anew; the state is one-hot."""

    n = 5
    observation_space = spaces.Box(0.0, 1.0, (n,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, terminates: bool) -> None:
        self.terminates = terminates

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.now = 0
        return self._obs(), {}

    def step(self, action):
        self.now += 1
        over = self.now == self.n
        return self._obs(), float(self.now), over and self.terminates, over, {}

    def _obs(self):
        return np.eye(self.n, dtype=np.float32)[self.now % self.n]


@pytest.mark.parametrize("terminates", [False, True], ids=["truncated", "terminated"])
def test_batches_of_three_steps_are_sums_that_stop_at_the_end(terminates):
    env, gamma = Ramp(terminates), 0.9
    model = algos.GSDESAC(env=env, **(SETTINGS | {"n_steps": 3, "gamma": gamma})).learn(53)
    assert isinstance(model.replay_buffer, NStepReplayBuffer)

    batch = jax.tree.map(lambda x: np.asarray(x[0]), batches_of(model.replay_source, 1, 500, 1))

    first = batch.obs.argmax(-1)
    # The 53rd step is the third of an episode: what began one or two before it is cut short there.
    lengths = {(k, min(3, Ramp.n - k)) for k in range(Ramp.n)} | {(1, 2), (2, 1)}
    found = set()
    for k, reward, discount, over, after in zip(
        first, batch.reward, batch.discount, batch.terminated, batch.next_obs, strict=True
    ):
        n = round(np.log(discount) / np.log(gamma))
        found.add((int(k), n))
        assert reward == pytest.approx(sum(gamma**j * (k + j + 1) for j in range(n)), rel=1e-5)
        assert after.argmax() == (k + n) % Ramp.n and bool(over) == (terminates and k + n == Ramp.n)
    assert found == lengths
