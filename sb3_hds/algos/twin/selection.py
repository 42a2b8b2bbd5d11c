"""Which of the policies that came by is the one that acts."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sb3_hds.algos.twin.epoch import plan_ahead, regressions, side_by_side
from sb3_hds.algos.twin.networks import output
from sb3_hds.algos.twin.state import (
    EpochConfig,
    EpochState,
    Hyperparams,
    View,
    for_each,
    longest_episode,
    resets,
)
from sb3_hds.core import Twin
from sb3_hds.core.numerics.compilation import GENERATOR, QUICK_COMPILATION
from sb3_hds.planning import Problem, follow

# Simulated steps of a policy in a comparison, and the numbers of episodes between which they make.
_STEPS_COMPARED = 64_000
_FEWEST, _MOST = 32, 256


def choose_policy(
    config: EpochConfig, state: EpochState, hyper: Hyperparams, every: int, due: bool
) -> tuple[EpochState, Float[np.ndarray, " 2"] | None]:
    """
    After an epoch: the average acts, until it was first compared; then the better one does.

    :param every: epochs from one comparison to the next; 0: never
    :param due: compare after this epoch in any case, unless never
    :return: the state, and the returns of a comparison, see :func:`keep_better`
    """
    n_epochs = int(state.progress.n_epochs)
    if is_compared(n_epochs, every, due):
        return keep_better(config, state, hyper)
    if every and n_epochs > every:
        return state, None
    nets = state.networks
    acting = nets._replace(acting=nets.average, acting_inside=nets.inside)
    return state._replace(networks=acting), None


def is_compared(n_epochs: int, every: int, due: bool) -> bool:
    """:return: whether policies are compared after this number of epochs"""
    return every > 0 and (due or n_epochs % every == 0)


def programs(config: EpochConfig, state: EpochState, hyper: Hyperparams) -> list[Callable[[], Any]]:
    """:return: the programs of an epoch; running them once, in parallel, compiles them"""
    used = [plan_ahead, *regressions(config)]
    return [partial(program, config, state, hyper) for program in used]


def comparison(config: EpochConfig, state: EpochState, hyper: Hyperparams) -> Callable[[], Any]:
    """:return: the program of a comparison; running it once compiles it"""
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
    Let the average and the policy that acts go through whole episodes of the twin, from the same
    start states, and let the better one act: where a system falls over, a single epoch may spoil
    what took many to learn.

    :return: the state, and the mean return of both, in planning rewards
    """
    nets, progress = state.networks, state.progress
    pairs = ((nets.average, nets.inside), (nets.acting, nets.acting_inside))
    going = [partial(mean_return, config, hyper, progress.key, *pair) for pair in pairs]
    (of_average, key), (of_acting, _) = side_by_side(going)
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
    inside: View,
) -> tuple[jax.Array, jax.Array]:
    """
    :param key: random, as integers
    :return: mean return of a policy over whole episodes of the twin, in planning rewards; the key
        after that
    """
    after, k_starts = jax.random.split(jax.random.wrap_key_data(key, impl=GENERATOR))
    twin = config.twin
    problem = Problem(twin, hyper.params)
    starts = resets(twin, hyper.params, k_starts, _n_starts(twin))
    length = longest_episode(twin)
    spread = np.linspace(0, config.n_rollouts - 1, _n_starts(twin)).round().astype(int)
    varied = jax.tree.map(lambda leaf: leaf[spread], hyper.varied)
    policy = lambda obs: output(config.actor, actor, inside(hyper.view(obs)))  # noqa: E731
    value = lambda s, own: follow(problem.with_params(own), s, policy, length).value  # noqa: E731
    return jnp.mean(for_each(value, starts, varied)), jax.random.key_data(after)


def _n_starts(twin: Twin) -> int:
    return int(np.clip(_STEPS_COMPARED // longest_episode(twin), _FEWEST, _MOST))
