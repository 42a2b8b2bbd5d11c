"""Layers around an environment have twins, planners plan through them, learners store as asked."""

import json

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stable_baselines3 as sb3
from cases import each
from gymnasium.wrappers import TimeLimit
from moving_joints import DT, MovingJoints
from small_models import small
from stable_baselines3.common.noise import NormalActionNoise

from sb3_hds import PODS, twins
from sb3_hds.algos import ExecutedReplayBuffer
from sb3_hds.core import LowPass, Signals, TransformedTwin
from sb3_hds.effects import ViscousFriction
from sb3_hds.envs import twin_of
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

SCHEDULE = [[0, 0.3], [50, 1.0]]


def nested(env):
    env = LowPassAction(ActionDelay(env, 2), cutoff=4.0, order=3)
    env = ActionScale(ActionRateLimit(env, max_rate=10.0), schedule=SCHEDULE, axes=[0])
    return HistoryObservation(ContinuityCost(env, 0.3), n_observations=2, n_actions=2)


BARRIER = {"low": -2.0, "high": 2.0, "position": [[0, 1]], "gain": 0.5, "on_breach": "ignore"}
LAYERS = {
    # No speed is commanded here: what the twin does beyond its assumptions has to agree, too.
    "barrier": lambda env: JointLimitBarrier(env, **BARRIER),
    "rhythm_residual": lambda env: CPGPrior(env, mode="residual", omega_swing=3.0, amplitude=2.5),
    "rhythm_parameters": lambda env: CPGPrior(env, mode="parameters", omega_swing=3.0, offset=0.3),
    "nested": nested,
}


@pytest.mark.parametrize("layer", LAYERS)
def test_a_wrapped_pendulum_and_its_twin_agree_step_for_step(layer, x64):
    env = LAYERS[layer](gymnasium.make("Pendulum-v1"))
    twin = twin_of(env)
    step, reward, infer = map(jax.jit, (twin.step, twin.reward, twin.infer))
    observe = jax.jit(twin.observe)
    obs, _ = env.reset(seed=1)
    env.action_space.seed(1)
    alone = infer(jnp.asarray(obs, jnp.float64), twin.params)

    for k in range(80):
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


@pytest.mark.parametrize("layer", LAYERS)
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


def test_derivatives_of_a_filter_pass_through_the_twin(x64):
    # g = 2 / 3, so g / (1 + g) = 0.4.
    low_pass = LowPass(cutoff=np.arctan(2.0 / 3.0) / np.pi, order=1)
    twin = TransformedTwin(Pendulum(), stateful=low_pass)
    state = twin.infer(jnp.array([1.0, 0.0, 0.0, 0.1]), twin.params)

    slope = jax.jacfwd(lambda u: twin.step(state, u, twin.params).v[0])(jnp.zeros(1))

    # The command is 0.4 u + z; 1 N m during 0.05 s speeds m l^2 / 3 up by 0.15.
    assert float(slope[0]) == pytest.approx(0.4 * 0.15, rel=1e-9)


@pytest.mark.parametrize(("cutoff", "order"), [(1e-4, 1), (1e-3, 8), (0.4, 8)])
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


def jumping():
    """Actions of ±2 that a rate limit turns into changes of 0.5."""
    return ActionRateLimit(gymnasium.make("Pendulum-v1"), max_rate=10.0, store="executed")


def test_our_learners_store_what_was_executed():
    model = small("droq", jumping(), learning_starts=40).learn(30)

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
    how = {"learning_starts": 50, "buffer_size": 100, "seed": 0}
    model = sb3.SAC("MlpPolicy", jumping(), replay_buffer_class=ExecutedReplayBuffer, **how)
    model.learn(30)

    buffer = model.replay_buffer
    told = buffer.next_observations[:30, 0, 3]
    np.testing.assert_allclose(2.0 * buffer.actions[:30, 0, 0], told, atol=1e-5)


def test_planners_plan_through_layers_and_so_keep_what_was_chosen():
    noise = NormalActionNoise(np.zeros(1), np.ones(1))
    # Without an epoch of planning: that one swings up is seen below.
    model = small("pods", jumping(), action_noise=noise, pretrain_epochs=0, train_freq=50).learn(25)

    assert model.twin == twin_of(model.env) and isinstance(model.twin, TransformedTwin)
    buffer = model.replay_buffer
    told = buffer.next_observations[:25, 0, 3]
    assert np.max(np.abs(2.0 * buffer.actions[:25, 0, 0] - told)) > 0.1


class Corrections(gymnasium.Wrapper):
    """Counts steps in which a layer below changed what was chosen."""

    n = 0

    def step(self, action):
        result = self.env.step(action)
        self.n += bool(np.any(np.abs(result[4].get("correction", 0.0)) > 1e-6))
        return result


def within_06(obs):
    """Half of the distance to 0.6 rad on either side in a step: G u <= h."""
    return [[DT], [-DT]], [0.5 * (0.6 - obs[0]), 0.5 * (0.6 + obs[0])]


@pytest.mark.expensive
@each(
    lambda env: JointLimitBarrier(env, -0.6, 0.6),
    lambda env: ActionShield(env, within_06),
    ids=["barrier", "shield"],
)
def test_a_policy_trained_behind_a_layer_that_does_not_bind_solves_the_task(guard):
    settings = {"learning_starts": 200, "learning_rate": 3e-3, "gamma": 0.9, "batch_size": 64}
    before, after = (Corrections(guard(TimeLimit(MovingJoints(1, goal=0.3), 50))) for _ in range(2))
    model = small("tqc_jax", before, **settings, gradient_steps=5).learn(2_000)
    total = 0.0
    for episode in range(20):
        obs, _ = after.reset(seed=episode)
        for _ in range(50):
            obs, reward, *_ = after.step(model.predict(obs, deterministic=True)[0])
            total += reward

    # Who stays where it begins gets -50 (0.3^2 + 0.45^2 / 3) = -8; the best of all, about -0.2.
    assert total / 20 > -0.8 and before.n > 0 and after.n == 0


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
