"""Layers around an environment have twins, planners plan through them, learners store as asked."""

import functools
import json

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stable_baselines3 as sb3
from small_models import small
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_hds import PODS, twins
from sb3_hds.algos import ExecutedReplayBuffer
from sb3_hds.core import LowPass, RateLimit, RescaleAction, Signals, TransformedTwin
from sb3_hds.effects import ViscousFriction
from sb3_hds.envs import TwinEnv, twin_of
from sb3_hds.errors import EnvironmentMismatchError, ParameterError
from sb3_hds.twins import Pendulum
from sb3_hds.wrappers import (
    ActionDelay,
    ActionRateLimit,
    ActionScale,
    ActionShield,
    ContinuityCost,
    CPGPrior,
    HistoryObservation,
    JointLimitBarrier,
    LowPassAction,
)

pytestmark = pytest.mark.usefixtures("quick_compilation")


def nested(env):
    env = LowPassAction(ActionDelay(env, 2), cutoff=4.0)
    env = ActionScale(ActionRateLimit(env, max_rate=10.0), schedule=SCHEDULE)
    return HistoryObservation(ContinuityCost(env, 0.3), n_observations=1, n_actions=2)


SCHEDULE = [[0, 0.3], [150, 1.0]]


LAYERS = {
    "low_pass": lambda env: LowPassAction(env, cutoff=4.0, order=3),
    "scale_of_some": lambda env: ActionScale(env, schedule=SCHEDULE, axes=[0]),
    "history": lambda env: HistoryObservation(env, n_observations=2, n_actions=2),
    # No speed is commanded here: what the twin does beyond its assumptions has to agree, too.
    "barrier": lambda env: JointLimitBarrier(
        env, -2.0, 2.0, position=[[0, 1]], gain=0.5, on_breach="ignore"
    ),
    "rhythm_offset": lambda env: CPGPrior(env, omega_swing=3.0, omega_stance=5.0, phase=0.4),
    "rhythm_residual": lambda env: CPGPrior(env, mode="residual", omega_swing=3.0, amplitude=2.5),
    "rhythm_parameters": lambda env: CPGPrior(env, mode="parameters", omega_swing=3.0, offset=0.3),
    # Rate limit, delay, scale, continuity cost and history among them.
    "nested": nested,
}
ALL = pytest.mark.parametrize("layer", LAYERS)


@ALL
def test_a_wrapped_pendulum_and_its_twin_agree_step_for_step(layer, x64):
    env = LAYERS[layer](gymnasium.make("Pendulum-v1"))
    twin = twin_of(env)
    step, reward, infer = map(jax.jit, (twin.step, twin.reward, twin.infer))
    observe = jax.jit(twin.observe)
    obs, _ = env.reset(seed=1)
    env.action_space.seed(1)
    alone = infer(jnp.asarray(obs, jnp.float64), twin.params)

    for k in range(200):
        action = env.action_space.sample()
        state, command = infer(jnp.asarray(obs, jnp.float64), twin.params), jnp.float64(action)
        obs, given, *_ = env.step(action)
        after, alone = (step(s, command, twin.params) for s in (state, alone))
        # From an observation in single precision: 6e-8 of a speed of 8 rad/s and of each filter;
        # the reward squares an angle of up to pi and a speed of up to 8 rad/s.
        np.testing.assert_allclose(observe(after, twin.params), obs, atol=5e-6)
        assert float(reward(state, command, after, twin.params)) == pytest.approx(given, abs=5e-5)
        # A twin that never saw the environment again: the pendulum magnifies what was rounded,
        # without bound after some seconds.
        if k < 50:
            np.testing.assert_allclose(observe(alone, twin.params), obs, atol=5e-3)
    # What is seen tells the state of the twin.
    back = infer(observe(alone, twin.params), twin.params)
    for ours, theirs in zip(jax.tree.leaves(alone), jax.tree.leaves(back), strict=True):
        np.testing.assert_allclose(jnp.sin(ours), jnp.sin(theirs), atol=1e-9)  # angles turn


@ALL
def test_the_twin_survives_a_spec_effects_and_another_interval(layer):
    env = LAYERS[layer](gymnasium.make("Pendulum-v1", g=9.0))
    twin = twin_of(env)

    back = twins.from_spec(json.loads(json.dumps(twin.to_spec())))

    assert back == twin and back.params == twin.params and hash(back) == hash(twin)
    extended = twin.extend(ViscousFriction(b=0.1))
    assert "viscous_friction.hinge.b" in extended.parameters
    assert extended.without("viscous_friction.hinge") == twin
    assert twin.at_interval(0.1, 2).channels == twin.channels
    np.testing.assert_allclose([c.low for c in twin.channels], env.observation_space.low)
    np.testing.assert_allclose([c.high for c in twin.channels], env.observation_space.high)


def test_copies_in_other_processes_have_the_same_twin():
    def make():
        return nested(gymnasium.make("Pendulum-v1", g=9.0))

    expected, env = twin_of(make()), SubprocVecEnv([make])
    try:
        found = twin_of(env)
    finally:
        env.close()

    assert found == expected and found.values["gravity"] == 9.0
    assert twin_of(DummyVecEnv([make, make])) == expected


def test_an_environment_made_of_a_twin_behind_a_layer_agrees_with_the_wrapped_one():
    layer = ActionDelay(gymnasium.make("Pendulum-v1"), 2)
    made = TwinEnv(twin_of(layer))
    start = made.reset(seed=0)[0]
    layer.reset(seed=0)
    layer.unwrapped.state = np.array([np.arctan2(start[1], start[0]), start[2]])

    for action in ([2.0], [-1.0], [0.5], [2.0]):
        ours, theirs = (env.step(np.array(action, np.float32))[0] for env in (made, layer))
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_layers_without_a_twin_are_refused_by_name():
    env = ActionShield(gymnasium.make("Pendulum-v1"), ([[1.0]], [1.0]))

    with pytest.raises(EnvironmentMismatchError, match="wrapper ActionShield may"):
        twin_of(LowPassAction(env, 4.0))


def test_a_stateful_transform_comes_alone():
    limit = RateLimit(max_change=1.0)

    with pytest.raises(ParameterError, match="one TransformedTwin into another"):
        TransformedTwin(Pendulum(), stateful=limit, action=RescaleAction())


def test_derivatives_of_a_filter_pass_through_the_twin(x64):
    # g = 2 / 3, so g / (1 + g) = 0.4.
    low_pass = LowPass(cutoff=np.arctan(2.0 / 3.0) / np.pi, order=1)
    twin = TransformedTwin(Pendulum(), stateful=low_pass)
    state = twin.infer(jnp.array([1.0, 0.0, 0.0, 0.1]), twin.params)

    slope = jax.jacfwd(lambda u: twin.step(state, u, twin.params).v[0])(jnp.zeros(1))

    # The command is 0.4 u + z; 1 N m during 0.05 s speeds m l^2 / 3 up by 0.15.
    assert float(slope[0]) == pytest.approx(0.4 * 0.15, rel=1e-9)


@pytest.mark.parametrize(("cutoff", "order"), [(1e-4, 1), (1e-3, 8), (0.1, 3), (0.4, 8)])
def test_a_constant_passes_a_filter_in_single_precision(cutoff, order):
    low_pass = LowPass(cutoff=cutoff, order=order)
    below = Signals(Pendulum().actuators, Pendulum().channels)
    command = jnp.full(1, 1.3, jnp.float32)

    def step(memory, _):
        passed, memory = low_pass.act(command, jnp.zeros(3), memory, below)
        return memory, passed

    start = jnp.asarray(low_pass.start(np.zeros(3, np.float32), below))
    _, passed = jax.lax.scan(step, start, length=200 + int(20 / cutoff))

    assert float(passed[-1, 0]) == pytest.approx(1.3, rel=2e-3)


# --- learners ------------------------------------------------------------------------------------


def jumping():
    """Actions of ±2 that a rate limit turns into changes of 0.5."""
    return ActionRateLimit(gymnasium.make("Pendulum-v1"), max_rate=10.0, store="executed")


@pytest.mark.parametrize("name", ["droq", pytest.param("td7", marks=pytest.mark.expensive)])
def test_our_learners_store_what_was_executed(name):
    model = small(name, jumping(), learning_starts=40)

    model.learn(30)

    stored = 2.0 * model.replay_buffer.actions[:30, 0, 0]  # from [-1, 1] to N m
    assert np.max(np.abs(np.diff(stored, prepend=0.0))) <= 0.5 + 1e-5
    # The observation that follows holds the same command.
    np.testing.assert_allclose(stored, model.replay_buffer.next_observations[:30, 0, 3], atol=1e-5)


@pytest.mark.parametrize(("limit", "says"), [(1.0, "changes actions"), (0.1, "rescales actions")])
def test_a_layer_below_another_that_rescales_is_found_out(limit, says):
    env = gymnasium.wrappers.RescaleAction(jumping(), np.float32(-limit), np.float32(limit))

    with pytest.raises(ValueError, match=f"outside that layer {says}"):
        small("droq", env, learning_starts=40).learn(30)


def test_learners_of_sb3_store_what_was_executed_with_our_buffer():
    stock, ours = (
        sb3.SAC(
            "MlpPolicy", jumping(), learning_starts=50, buffer_size=100, seed=0, **arguments
        ).learn(30)
        for arguments in ({}, {"replay_buffer_class": ExecutedReplayBuffer})
    )

    chosen, executed = (2.0 * model.replay_buffer.actions[:30, 0, 0] for model in (stock, ours))
    told = ours.replay_buffer.next_observations[:30, 0, 3]
    np.testing.assert_allclose(executed, told, atol=1e-5)
    assert np.max(np.abs(chosen - told)) > 1.0


@pytest.mark.parametrize(
    "wrap", [lambda env: env, pytest.param(nested, marks=pytest.mark.expensive)]
)
def test_planners_plan_through_layers_and_so_keep_what_was_chosen(wrap):
    noise = NormalActionNoise(np.zeros(1), np.ones(1))
    model = small("pods", wrap(jumping()), action_noise=noise)
    before = jax.tree.leaves(model.policy.networks.actor)

    model.learn(25)

    assert model.twin == twin_of(model.env) and isinstance(model.twin, TransformedTwin)
    after = jax.tree.leaves(model.policy.networks.actor)
    assert any(not np.array_equal(a, b) for a, b in zip(before, after, strict=True))
    buffer = model.replay_buffer
    told = buffer.next_observations[:25, 0, 3]
    assert np.max(np.abs(2.0 * buffer.actions[:25, 0, 0] - told)) > 0.1


# --- returns where a layer does not bind ---------------------------------------------------------


class Reacher(gymnasium.Env):
    """A joint commanded by its speed that has to go to 0.3 rad, from anywhere within 1 rad."""

    dt = 0.05

    def __init__(self):
        self.observation_space = gymnasium.spaces.Box(-5.0, 5.0, (1,))
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.q, self.n = self.np_random.uniform(-1.0, 1.0), 0
        return np.array([self.q], np.float32), {}

    def step(self, action):
        self.q, self.n = self.q + float(action[0]) * self.dt, self.n + 1
        reward = 1.0 - abs(self.q - 0.3)
        return np.array([self.q], np.float32), reward, False, self.n >= 50, {}


class Corrections(gymnasium.Wrapper):
    """Counts steps in which a layer below changed what was chosen."""

    n = 0

    def step(self, action):
        result = self.env.step(action)
        self.n += bool(np.any(np.abs(result[4].get("correction", 0.0)) > 1e-6))
        return result


def within_105(obs):
    """Half of the distance to 1.05 rad on either side in a step: G u <= h."""
    step = Reacher.dt
    return [[step], [-step]], [0.5 * (1.05 - obs[0]), 0.5 * (1.05 + obs[0])]


GUARDS = {
    "none": lambda env: env,
    # 50 steps of 0.05 rad lead to 3.5 rad at most.
    "barrier, far": lambda env: JointLimitBarrier(env, -4.0, 4.0),
    "shield, far": lambda env: ActionShield(env, ([[1.0], [-1.0]], [1.1, 1.1])),
    # Active beyond 0.95 rad for who goes on outwards, which only exploration does.
    "barrier, near": lambda env: JointLimitBarrier(env, -1.05, 1.05),
    "shield, near": lambda env: ActionShield(env, within_105),
}


@functools.cache
def trained(guard):
    """:return: mean return, and corrections while training and after it"""
    settings = {"learning_starts": 200, "learning_rate": 3e-3, "gamma": 0.9, "batch_size": 64}
    before, after = (Corrections(GUARDS[guard](Reacher())) for _ in range(2))
    model = small("tqc_jax", before, **settings, gradient_steps=5).learn(2_000)
    total = 0.0
    for episode in range(20):
        obs, _ = after.reset(seed=episode)
        for _ in range(50):
            obs, reward, *_ = after.step(model.predict(obs, deterministic=True)[0])
            total += reward
    return total / 20, before.n, after.n


@pytest.mark.expensive
@pytest.mark.parametrize("guard", [name for name in GUARDS if name != "none"])
def test_a_policy_trained_behind_a_layer_that_does_not_bind_is_as_good_as_without(guard):
    free, *_ = trained("none")

    guarded, explored, used = trained(guard)

    assert free > 35.0  # a policy that stays where it begins gets 50 (1 - 0.55) = 22
    assert guarded > free - 0.05 * abs(free)
    assert (explored > 0) == guard.endswith("near") and used == 0


@pytest.mark.expensive
def test_pods_swings_up_through_a_low_pass():
    env = LowPassAction(gymnasium.make("Pendulum-v1"), cutoff=4.0)
    model = PODS("MlpPolicy", env, seed=0)

    model.learn(200)

    total = 0.0
    for episode in range(20):
        obs, _ = env.reset(seed=100 + episode)
        done = False
        while not done:
            obs, reward, _, done, _ = env.step(model.predict(obs, deterministic=True)[0])
            total += reward
    assert total / 20 > -250.0  # model-free learners reach about -150 without a filter
