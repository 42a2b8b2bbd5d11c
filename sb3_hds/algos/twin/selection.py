"""Which of the policies that came by is the one that acts."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.algos.twin.epoch import learn_from_plans, plan_ahead
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
) -> tuple[EpochState, Float[Array, " 2"] | None]:
    """
    After an epoch: the average acts, until it was first compared; then the better one does.

    :param every: epochs from one comparison to the next; 0: never
    :param due: compare after this epoch in any case, unless never
    :return: the state, and the returns of a comparison, see :func:`keep_better`
    """
    n_epochs = int(state.progress.n_epochs)
    if every and (due or n_epochs % every == 0):
        return keep_better(config, state, hyper)
    if every and n_epochs > every:
        return state, None
    nets = state.networks
    acting = nets._replace(acting=nets.average, acting_inside=nets.inside)
    return state._replace(networks=acting), None


def programs(
    config: EpochConfig, state: EpochState, hyper: Hyperparams, compares: bool
) -> list[Callable[[], Any]]:
    """
    :param compares: whether policies will be compared
    :return: the programs of an epoch; running them once, in parallel, compiles them
    """
    used = [plan_ahead, learn_from_plans, *([keep_better] if compares else [])]
    return [partial(program, config, state, hyper) for program in used]


def twin_steps_per_comparison(config: EpochConfig) -> int:
    """:return: simulated steps of a comparison, if no episode ends early"""
    return 2 * _n_starts(config.twin) * longest_episode(config.twin)


@partial(jax.jit, static_argnums=0, compiler_options=QUICK_COMPILATION)
def keep_better(
    config: EpochConfig, state: EpochState, hyper: Hyperparams
) -> tuple[EpochState, Float[Array, " 2"]]:
    """
    Let the average and the policy that acts go through whole episodes of the twin, from the same
    start states, and let the better one act: where a system falls over, a single epoch may spoil
    what took many to learn.

    :return: the state, and the mean return of both, in planning rewards
    """
    key, k_starts = jax.random.split(jax.random.wrap_key_data(state.progress.key, impl=GENERATOR))
    twin, nets = config.twin, state.networks
    problem = Problem(twin, hyper.params)
    starts = resets(twin, hyper.params, k_starts, _n_starts(twin))
    length = longest_episode(twin)
    spread = np.linspace(0, config.n_rollouts - 1, _n_starts(twin)).round().astype(int)
    varied = jax.tree.map(lambda leaf: leaf[spread], hyper.varied)

    def mean_return(actor: Mapping[str, Any], inside: View) -> jax.Array:
        policy = lambda obs: output(config.actor, actor, inside(hyper.view(obs)))  # noqa: E731
        value = lambda s, own: follow(problem.with_params(own), s, policy, length).value  # noqa: E731
        return jnp.mean(for_each(value, starts, varied))

    pairs = ((nets.average, nets.inside), (nets.acting, nets.acting_inside))
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *pairs)
    returns = jax.lax.map(lambda pair: mean_return(*pair), together)
    better = returns[0] > returns[1]
    acting, inside = jax.tree.map(lambda new, old: jnp.where(better, new, old), *pairs)
    state = state._replace(
        networks=nets._replace(acting=acting, acting_inside=inside),
        progress=state.progress._replace(key=jax.random.key_data(key)),
    )
    return state, returns


def _n_starts(twin: Twin) -> int:
    return int(np.clip(_STEPS_COMPARED // longest_episode(twin), _FEWEST, _MOST))
