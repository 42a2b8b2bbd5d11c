"""Which policy acts: the averaged one, or the better one in a comparison on full episodes."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sb3_hds.algos.twin.policy import Normalization, output
from sb3_hds.algos.twin.state import (
    EpochConfig,
    EpochState,
    Hyperparams,
    grouped_vmap,
    longest_episode,
    resets,
)
from sb3_hds.algos.twin.threads import run_in_parallel
from sb3_hds.core import Params, State, Twin
from sb3_hds.core.numerics.compilation import GENERATOR, QUICK_COMPILATION
from sb3_hds.planning import Problem, follow

# Simulated steps of each policy in a comparison, and the limits of the number of episodes.
_STEPS_COMPARED = 64_000
_FEWEST, _MOST = 32, 256


def choose_policy(
    config: EpochConfig,
    state: EpochState,
    hyper: Hyperparams,
    due: bool,
    was_compared: bool,
) -> tuple[EpochState, Float[np.ndarray, " 2"] | None]:
    """
    After an epoch: the averaged policy acts until the first comparison, then the better one does.

    :param due: whether policies are compared after this epoch, see :func:`is_compared`
    :param was_compared: whether there was a comparison after an earlier epoch
    :return: the state, and the returns of a comparison, see :func:`keep_better`
    """
    if due:
        return keep_better(config, state, hyper)
    if was_compared:
        return state, None
    nets = state.networks
    acting = nets._replace(acting=nets.average, acting_inside=nets.inside)
    return state._replace(networks=acting), None


def is_compared(n_epochs: int, every: int, anyway: bool) -> bool:
    """:return: whether policies are compared: ``anyway``, or every n-th epoch; 0: never"""
    return every > 0 and (anyway or n_epochs % every == 0)


def comparison(config: EpochConfig, state: EpochState, hyper: Hyperparams) -> Callable[[], Any]:
    """:return: the program of a comparison, to be compiled by running it once"""
    nets = state.networks
    given = (state.progress.key, nets.average, nets.inside)
    return partial(mean_return, config, hyper, *given)


def twin_steps_per_comparison(config: EpochConfig) -> int:
    """:return: simulated steps of a comparison, if no episode ends early"""
    return 2 * _n_starts(config.twin) * longest_episode(config.twin)


def keep_better(
    config: EpochConfig, state: EpochState, hyper: Hyperparams
) -> tuple[EpochState, Float[np.ndarray, " 2"]]:
    """
    Compare the averaged policy with the one that acts on full episodes of the twin from the same
    start states, and let the better one act: for a system that can fall, a single epoch may spoil
    the policy.

    :return: the state, and the mean return of both, in planning rewards
    """
    nets, progress = state.networks, state.progress
    pairs = ((nets.average, nets.inside), (nets.acting, nets.acting_inside))
    going = [partial(mean_return, config, hyper, progress.key, *pair) for pair in pairs]
    (of_average, key), (of_acting, _) = run_in_parallel(going)
    returns = np.array([float(of_average), float(of_acting)], np.float32)
    acting, inside = pairs[0] if returns[0] > returns[1] else pairs[1]
    return state._replace(
        networks=nets._replace(acting=acting, acting_inside=inside),
        progress=progress._replace(key=key),
    ), returns


@partial(jax.jit, static_argnums=0, compiler_options=QUICK_COMPILATION)
def mean_return(
    config: EpochConfig,
    hyper: Hyperparams,
    key: jax.Array,
    actor: Mapping[str, Any],
    inside: Normalization,
) -> tuple[jax.Array, jax.Array]:
    """
    :param key: random key, as integers
    :return: mean return of a policy over full episodes of the twin, in planning rewards; the next
        random key
    """
    after, k_starts = jax.random.split(jax.random.wrap_key_data(key, impl=GENERATOR))
    twin = config.twin
    problem = Problem(twin, hyper.params)
    starts = resets(twin, hyper.params, k_starts, _n_starts(twin))
    length = longest_episode(twin)
    rollouts = np.linspace(0, config.n_rollouts - 1, _n_starts(twin)).round().astype(int)
    varied = jax.tree.map(lambda leaf: leaf[rollouts], hyper.varied)
    policy = lambda obs: output(config.actor, actor, inside(hyper.vec_normalize(obs)))  # noqa: E731

    def value(start: State, varied: Params) -> jax.Array:
        return follow(problem.with_params(varied), start, policy, length).value

    return jnp.mean(grouped_vmap(value, starts, varied)), jax.random.key_data(after)


def _n_starts(twin: Twin) -> int:
    return int(np.clip(_STEPS_COMPARED // longest_episode(twin), _FEWEST, _MOST))
