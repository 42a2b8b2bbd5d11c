"""
The compiled programs of the environments.

Values of parameters are arguments, so all environments of equal twins share one compilation. States
are returned as numpy arrays, which can be pickled and copied and belong to no device.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sb3_hds.core import Params, State, Twin


class Transition(NamedTuple):
    """
    The result of one step of a twin, with a leading axis for several copies.

    :param state: after the step
    :param obs: observation of that state
    :param reward: of this step
    :param terminated: whether that state is terminal
    """

    state: State
    obs: Any
    reward: Any
    terminated: Any


class BatchTransition(NamedTuple):
    """
    The result of one step of many copies; those whose episode ended have been reset.

    :param state: at the start of the next step, leading axis ``n_envs``
    :param obs: observation of that state, ``(n_envs, n_obs)``
    :param elapsed: steps since the start of each episode, ``(n_envs,)``
    :param ended: the step itself, before any reset
    :param truncated: whether the step limit was reached, ``(n_envs,)``
    """

    state: State
    obs: Any
    elapsed: Any
    ended: Transition
    truncated: Any


class Programs(NamedTuple):
    """
    Compiled functions of a twin: for one copy, or for many, with a leading axis ``n_envs``.

    :param draw: ``(seed, params) -> state`` at the start of an episode
    :param observe: ``(state, params) -> obs``
    :param sketch: ``(state, params) -> points``
    :param step: for one copy ``(state, action, params) -> Transition``; for many ``(states,
        elapsed, actions, seeds, limit, params) -> BatchTransition``, where ``seeds`` are those of
        the episodes that begin if a copy ends
    """

    draw: Callable[..., State]
    observe: Callable[..., Any]
    sketch: Callable[..., Any]
    step: Callable[..., Any]


@functools.lru_cache(maxsize=64)
def for_one(twin: Twin) -> Programs:
    """:return: the programs of a single copy"""
    return Programs(*map(jax.jit, _pure(twin)))


@functools.lru_cache(maxsize=64)
def for_many(twin: Twin) -> Programs:
    """:return: the programs of any number of copies that share their parameters"""
    pure = _pure(twin)
    draw, observe, sketch = (jax.vmap(function, (0, None)) for function in pure[:3])
    transition = jax.vmap(pure.step, (0, 0, None))

    def step(
        states: State, elapsed: Any, actions: Any, seeds: Any, limit: Any, params: Params
    ) -> BatchTransition:
        ended = transition(states, actions, params)
        elapsed = elapsed + 1
        truncated = elapsed >= limit
        done = ended.terminated | truncated

        def reset() -> tuple[State, Any]:
            def where_done(new: Any, old: Any) -> Any:
                return jnp.where(done.reshape(done.shape + (1,) * (new.ndim - 1)), new, old)

            fresh = draw(seeds, params)
            start = fresh, observe(fresh, params)
            return jax.tree.map(where_done, start, (ended.state, ended.obs))

        # Outside vmap, so drawing costs nothing in the many steps in which no copy ends.
        state, obs = jax.lax.cond(jnp.any(done), reset, lambda: (ended.state, ended.obs))
        return BatchTransition(state, obs, jnp.where(done, 0, elapsed), ended, truncated)

    return Programs(*map(jax.jit, (draw, observe, sketch, step)))


def _pure(twin: Twin) -> Programs:
    def draw(seed: Any, params: Params) -> State:
        return twin.initial(jax.random.key(seed), params)

    def step(state: State, action: Any, params: Params) -> Transition:
        after = twin.step(state, action, params)
        reward = twin.reward(state, action, after, params)
        return Transition(
            after, twin.observe(after, params), reward, twin.terminated(after, params)
        )

    return Programs(draw, twin.observe, twin.sketch, step)
