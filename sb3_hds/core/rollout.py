"""
Rollouts of a twin under given actions or under a policy. Pure and unbatched: callers ``vmap``.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sb3_hds.core.twin import State, Twin
from sb3_hds.core.types import Action, Flag, Obs, Params, Scalar

#: reward as a function of ``(state, action, next_state, params)``, such as ``Twin.reward``
Reward = Callable[[State, Action, State, Params], Scalar]
Policy = Callable[[Obs], Action]


class Rollout(NamedTuple):
    """
    One simulated episode of ``steps`` steps.

    :param states: the initial state first; each leaf has ``steps + 1`` rows
    :param obs: observations of these states, shape ``(steps + 1, n_obs)``
    :param actions: action k acts from state k to state k + 1, shape ``(steps, n_act)``
    :param rewards: zero where not ``alive``, shape ``(steps,)``
    :param alive: whether step k starts before the episode has terminated, shape ``(steps,)``
    """

    states: State
    obs: Float[Array, "rows obs"]
    actions: Float[Array, "steps act"]
    rewards: Float[Array, " steps"]
    alive: Bool[Array, " steps"]


def rollout(
    twin: Twin,
    params: Params,
    state: State,
    actions: Float[Array, "steps act"],
    reward: Reward | None = None,
) -> Rollout:
    """
    Apply a sequence of actions.

    The step that terminates the episode is still rewarded; afterwards the state is frozen and
    rewards are zero, so that gradients do not depend on the motion of a fallen system. There is no
    reset.

    :param actions: shape ``(steps, n_act)``
    :param reward: for example ``twin.planning_reward``; default: ``twin.reward``
    """
    return _simulate(twin, params, state, lambda _, action: action, actions, reward)


def rollout_policy(
    twin: Twin,
    params: Params,
    state: State,
    policy: Policy,
    n_steps: int,
    reward: Reward | None = None,
) -> Rollout:
    """
    As :func:`rollout`, with the actions of a policy.

    :param policy: observation, shape ``(n_obs,)``, to action, shape ``(n_act,)``
    :param n_steps: length of the rollout
    :param reward: for example ``twin.planning_reward``; default: ``twin.reward``
    """

    def choose(state: State, _: Array) -> Action:
        return policy(twin.observe(state, params))

    return _simulate(twin, params, state, choose, jnp.arange(n_steps), reward)


def _simulate(
    twin: Twin,
    params: Params,
    state: State,
    choose: Callable[[State, Array], Action],
    inputs: Array,
    reward: Reward | None,
) -> Rollout:
    reward = twin.reward if reward is None else reward

    def advance(
        carry: tuple[State, Flag], given: Array
    ) -> tuple[tuple[State, Flag], tuple[State, Action, Scalar, Flag]]:
        state, alive = carry
        action = choose(state, given)
        after = twin.step(state, action, params)
        earned = jnp.where(alive, reward(state, action, after, params), 0.0)
        after = jax.tree.map(lambda new, old: jnp.where(alive, new, old), after, state)
        return (after, alive & ~twin.terminated(after, params)), (after, action, earned, alive)

    start = (state, ~twin.terminated(state, params))
    _, (later, actions, rewards, alive) = jax.lax.scan(advance, start, inputs)
    states = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), state, later)
    obs = jax.vmap(lambda state: twin.observe(state, params))(states)
    return Rollout(states, obs, actions, rewards, alive)
