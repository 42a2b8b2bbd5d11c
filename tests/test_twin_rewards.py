"""Rewards of our own, and the surrogates that planning climbs where a reward is flat."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sb3_hds import twins
from sb3_hds.core import State


def state_of(q, v):
    return State(jnp.asarray(q, jnp.float64), jnp.asarray(v, jnp.float64), {})


def test_cart_pole_is_best_at_rest_upright_in_the_middle(x64):
    twin = twins.make("CartPole")
    best, hanging = state_of([0.0, 0.0], [0.0, 0.0]), state_of([0.5, math.pi], [1.0, 2.0])

    assert twin.reward(best, jnp.zeros(1), best, twin.params) == 0.0
    # -2 (1 - cos pi) - 0.2 0.25 - 0.01 (1 + 4 + 0.25)
    expected = -4.0 - 0.05 - 0.0525
    value = twin.reward(hanging, jnp.array([5.0]), hanging, twin.params)
    assert value == pytest.approx(expected, rel=1e-14)


def test_the_payloads_reward_is_the_papers(x64):
    stop, origin = (twins.make("PayloadPendulum", goal=g) for g in ("stop", "stop_at_origin"))
    state, action = state_of([0.3, 0.4, math.pi / 2], [0.5, 0.0, 2.0]), jnp.array([1.0, -1.0])
    # Payload 1 m to the right of the handle, moving with the handle and at 2 m/s upwards.
    payload, velocity = (1.3, 1.4), (0.5, 2.0)
    cost_stop = 0.5 * (np.dot(velocity, velocity) + 0.1 * 2.0)
    cost_origin = cost_stop + 0.5 * (np.dot(payload, payload) + 0.25)

    for twin, cost in ((stop, cost_stop), (origin, cost_origin)):
        value = twin.reward(state, action, state, twin.params)
        assert value == pytest.approx(1.0 / (0.1 + cost), rel=1e-12)
        assert twin.planning_reward(state, action, state, twin.params) == pytest.approx(-cost)
    rest = state_of([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    assert origin.reward(rest, jnp.zeros(2), rest, origin.params) == pytest.approx(10.0)


def test_the_inverted_pendulums_surrogate_is_positive_and_best_at_rest_in_the_middle(x64):
    twin, still = twins.make("InvertedPendulum"), jnp.zeros(1)
    rng = np.random.default_rng(0)

    def planned(q, v):
        state = state_of(q, v)
        return float(twin.planning_reward(state, still, state, twin.params))

    assert planned([0.0, 0.0], [0.0, 0.0]) == 1.0
    assert planned([0.0, 0.2], [0.0, 0.0]) == pytest.approx(1.0 / 1.5)
    assert planned([1.0, 0.2], [5.0, 5.0]) == pytest.approx(1.0 / 3.0)
    for _ in range(100):
        assert 0.0 < planned(rng.normal(size=2), rng.normal(0.0, 20.0, 2)) < 1.0


def greedy_episode(twin, start, n_steps):
    """Choose at each step what the planning reward of that step alone likes best."""
    actions = jnp.linspace(-1.0, 1.0, 41)[:, None] ** 3  # finer around zero

    def advance(carry, _):
        state, alive, earned = carry
        after = jax.vmap(twin.step, (None, 0, None))(state, actions, twin.params)
        planned = jax.vmap(twin.planning_reward, (None, 0, 0, None))
        best = jnp.argmax(planned(state, actions, after, twin.params))
        after = jax.tree.map(lambda leaf: leaf[best], after)
        reward = twin.reward(state, actions[best], after, twin.params)
        over = twin.terminated(after, twin.params)
        return (after, alive & ~over, earned + alive * reward), None

    carry = (start, jnp.array(True), jnp.zeros(()))
    (_, alive, earned), _ = jax.lax.scan(advance, carry, None, n_steps)
    return alive, earned


def test_climbing_the_mountain_cars_surrogate_reaches_the_goal_cheaply(x64):
    """One step of foresight earns 93 from wherever the car stands off the valley's bottom."""
    twin = twins.make("MountainCar")
    x = np.linspace(-0.6, -0.4, 40)
    x = jnp.asarray(x[np.abs(x + math.pi / 6.0) > 0.005])[:, None]
    starts = State(x, jnp.zeros_like(x), {})

    alive, earned = jax.jit(jax.vmap(lambda s: greedy_episode(twin, s, 999)))(starts)

    assert not alive.any() and earned.min() >= 93.0


def test_climbing_the_acrobots_surrogate_swings_it_up(x64):
    """One step of foresight mostly does it in 150 steps, where random torque seldom does."""
    twin = twins.make("Acrobot")
    starts = jax.vmap(twin.initial, (0, None))(jax.random.split(jax.random.key(0), 32), twin.params)
    alive, _ = jax.jit(jax.vmap(lambda s: greedy_episode(twin, s, 150)))(starts)
    assert alive.mean() <= 0.25
