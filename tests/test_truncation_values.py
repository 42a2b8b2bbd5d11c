"""What a time limit does to values, in closed form and as every algorithm of ours learns them."""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from small_models import OFF_POLICY, PLANNERS
from stable_baselines3.common.buffers import NStepReplayBuffer

from sb3_hds import algos
from sb3_hds.algos import learn_compiled, td7_update
from sb3_hds.algos.observations import seen
from sb3_hds.algos.off_policy import judge
from sb3_hds.algos.sampling import batches_of
from sb3_hds.core import Actuator, AnalyticTwin, Channel, Joint, State
from sb3_hds.envs import ConstantReward, TwinEnv
from sb3_hds.errors import ParameterError
from sb3_hds.wrappers import TruncateToTerminate

GAMMA = 0.98
#: 1 / (1 - gamma), and the sum of gamma^k over the four steps of an episode: 50 and 3.88
TRUNCATED = 1.0 / (1.0 - GAMMA)
TERMINATED = (1.0 - GAMMA**4) / (1.0 - GAMMA)

# No bonus for entropy, or values would not be those of the reward. All actions are drawn from the
# whole range: a critic guesses too much where none was tried, and the actor finds that place
# (gSDE-SAC ended at 50 to 59 with 50 such steps, at 49.5 to 50.5 with 200).
_COMMON = {
    "gamma": GAMMA,
    "learning_starts": 200,
    "gradient_steps": 0,
    "buffer_size": 400,
    "train_freq": 1,
    "seed": 0,
}
_NET = {"net_arch": [32]}
_SOFT = _COMMON | {
    "ent_coef": 1e-6,
    "tau": 0.1,
    "learning_rate": 1e-2,
    "policy_delay": 10,
    "policy_kwargs": _NET,
}
#: an algorithm is tested as soon as it has an entry here: arguments and updates
LEARNERS: dict[str, tuple[dict[str, Any], int]] = {
    "gsde_sac": (_SOFT, 2500),
    # Each backup takes the least of two critics, which dropout makes differ: in sum, 50 times that.
    # With a rate of 0.01 and 32 units, values end at 48.
    "droq": (_SOFT | {"policy_kwargs": _NET | {"dropout_rate": 1e-3}}, 2500),
    # One critic: the statistics of a batch make two of them differ, and the least of two ends at
    # 46 to 49.
    "crossq_jax": (_SOFT | {"learning_rate": 1e-3, "policy_kwargs": _NET | {"n_critics": 1}}, 4000),
    "tqc_jax": (_SOFT | {"policy_kwargs": _NET | {"n_quantiles": 5}}, 2500),
    "simba": (_SOFT, 2500),
    "bro": (_SOFT | {"policy_kwargs": _NET | {"n_quantiles": 5}, "param_resets": []}, 2500),
    # After 300 copies into the target networks, values could be at 1 - gamma^300 = 99.8 %; the
    # embedding of states that differ little is learned slowly, though: 45 to 48 after 12,000
    # updates, 49 after 24,000.
    "td7": (
        _COMMON
        | {
            "learning_starts": 50,
            "learning_rate": 3e-3,
            "target_update_interval": 20,
            "use_checkpoints": False,
            "policy_kwargs": {"net_arch": [64], "embedding_size": 8},
        },
        24_000,
    ),
}


def value_of(model: Any, obs: np.ndarray) -> float:
    """:return: what the critics think of a state and the middle action, in the mean"""
    policy, learner = model.policy, model.policy.learner
    flat = np.asarray(policy.flatten(np.asarray(obs)[None]))
    action = np.zeros((1, policy.n_act), np.float32)
    if isinstance(model, algos.TD7):
        recipe, encoder = policy.recipe, learner.copies.encoder
        embedded = td7_update.embed(recipe, encoder, flat, action)
        weights = learner.critic.weights
        return float(np.mean(td7_update.judge(recipe, weights, flat, action, *embedded)))
    if policy.recipe.normalize:
        flat = np.asarray(seen(learner.seen, flat))
    values, _ = judge(policy.recipe, learner.critic.weights, flat, action, jax.random.key(0))
    return float(np.mean(values))


def learned(name: str, env: gymnasium.Env, **changes: Any) -> float:
    """:return: the value of the first state, after as many updates as it takes"""
    arguments, n_updates = LEARNERS[name]
    model = algos.ALL[name](env=env, **(arguments | changes)).learn(200)
    model.train(n_updates, 64 if name == "td7" else 32)
    return value_of(model, env.reset()[0])


@pytest.mark.parametrize(
    "name",
    [
        name if name == "droq" else pytest.param(name, marks=pytest.mark.expensive)
        for name in sorted(set(OFF_POLICY) - set(PLANNERS))
    ],
)
@pytest.mark.parametrize("ends", [False, True], ids=["truncated", "terminated"])
def test_a_state_is_worth_what_follows_a_time_limit_unless_that_is_an_end(name, ends):
    env = gymnasium.make("sb3_hds/ConstantReward-v0")

    value = learned(name, TruncateToTerminate(env) if ends else env)

    assert pytest.approx((50.0, 3.88), abs=5e-3) == (TRUNCATED, TERMINATED)
    assert value == pytest.approx(TERMINATED if ends else TRUNCATED, rel=0.05)


class Clock(AnalyticTwin):
    """
    The twin of the example: a hand that goes round in four steps, whatever it is told, and is paid.

    :param over: option; whether the round is the end
    """

    name = "Clock"
    dt = 1.0
    joints = (Joint("hand", "rad"),)
    actuators = (Actuator("nothing", "1", -1.0, 1.0),)
    channels = (Channel("cos", "1", -1.0, 1.0), Channel("sin", "1", -1.0, 1.0))
    parameters = {}
    options = {"over": False}

    def initial(self, key, params):
        return State(jnp.zeros(1), jnp.full(1, 0.5 * jnp.pi), {})

    def infer(self, obs, params):
        return State(jnp.arctan2(obs[1:], obs[:1]), jnp.full(1, 0.5 * jnp.pi, obs.dtype), {})

    def observe(self, state, params):
        return jnp.concatenate([jnp.cos(state.q), jnp.sin(state.q)])

    def actuate(self, state, action, params):
        return 0.0 * action

    def mass_matrix(self, q, params):
        return jnp.ones((1, 1), q.dtype)

    def bias(self, q, v, params):
        return 0.0 * q

    def reward(self, state, action, next_state, params):
        return jnp.ones(())

    def terminated(self, state, params):
        return self.over & (state.q[0] > 1.9 * jnp.pi)


@pytest.mark.parametrize(
    ("over", "expected"), [(False, TRUNCATED), (True, TERMINATED)], ids=["truncated", "terminated"]
)
def test_what_learns_within_one_program_takes_a_time_limit_for_what_it_is(over, expected):
    env = TimeLimit(TwinEnv(Clock(over=over)), 4)
    arguments, n_updates = LEARNERS["gsde_sac"]
    n_steps = arguments["buffer_size"]
    each = n_updates // (n_steps - arguments["learning_starts"])
    model = algos.GSDESAC(env=env, **(arguments | {"gradient_steps": each, "batch_size": 32}))

    (learned,), (episodes,) = learn_compiled(model, n_steps)

    assert episodes.timesteps.tolist() == list(range(4, n_steps + 1, 4))
    assert value_of(learned, env.reset()[0]) == pytest.approx(expected, rel=0.05)


def test_the_example_is_a_clock_that_pays_the_same_for_ever():
    env = gymnasium.make("sb3_hds/ConstantReward-v0")
    start, _ = env.reset(seed=0)

    steps = [env.step(env.action_space.sample()) for _ in range(4)]

    assert [step[1:4] for step in steps] == [(1.0, False, k == 3) for k in range(4)]
    np.testing.assert_allclose(steps[0][0], [0.0, 1.0], atol=1e-6)
    # Round once: the last observation is one that is learned about.
    np.testing.assert_array_equal(steps[3][0], start)


@pytest.mark.parametrize("arguments", [{"period": 0}, {"reward": np.inf}, {"period": 2.5}])
def test_a_clock_that_cannot_be_is_refused(arguments):
    with pytest.raises(ParameterError, match=next(iter(arguments))):
        ConstantReward(**arguments)


# --- returns of several steps


class Ramp(gymnasium.Env):
    """
    Pays 1, 2, ..., 5 and begins anew; the state is one-hot.

    :param terminates: whether the fifth step is the end, or what comes then is the first state
    """

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

    def value(self, gamma: float) -> float:
        """Of the first state: one round, or one after the other."""
        one = sum(gamma**k * (k + 1) for k in range(self.n))
        return one if self.terminates else one / (1.0 - gamma**self.n)


@pytest.mark.expensive  # batches of several steps are looked at below
@pytest.mark.parametrize("terminates", [False, True], ids=["truncated", "terminated"])
@pytest.mark.parametrize("name", ["gsde_sac", "td7"])
def test_values_learned_from_three_steps_are_those_of_the_formula(name, terminates):
    env, gamma = Ramp(terminates), 0.9

    value = learned(name, env, n_steps=3, gamma=gamma)

    assert value == pytest.approx(env.value(gamma), rel=0.05)


@pytest.mark.parametrize("terminates", [False, True], ids=["truncated", "terminated"])
def test_batches_of_three_steps_are_sums_that_stop_at_the_end(terminates):
    env, gamma = Ramp(terminates), 0.9
    arguments, _ = LEARNERS["gsde_sac"]
    model = algos.GSDESAC(env=env, **(arguments | {"n_steps": 3, "gamma": gamma})).learn(53)
    assert isinstance(model.replay_buffer, NStepReplayBuffer)

    batch = jax.tree.map(lambda x: np.asarray(x[0]), batches_of(model, 1, 500, 1))

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
        assert after.argmax() == (k + n) % Ramp.n
        assert bool(over) == (terminates and k + n == Ramp.n)
    assert found == lengths
