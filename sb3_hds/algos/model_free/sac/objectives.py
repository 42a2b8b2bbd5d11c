"""
What critics are regressed on, their loss, and what the actor maximises: algorithms choose.

Sorting and the loss of quantiles are written twice, as one program serves neither processor: a CPU
walks through memory once, and an accelerator, where every operation waits for the one before, does
all in few of them.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Values = Float[Array, "critics batch values"]
Targets = Float[Array, "batch targets"]
Loss = Float[Array, ""]


def min_values(values: Values) -> Targets:
    """Of the critics, value by value: clipped double Q-learning (Fujimoto et al. 2018)."""
    return jnp.min(values, 0)


def mean_values(values: Values) -> Targets:
    """Of the critics, value by value (BRO)."""
    return jnp.mean(values, 0)


def squared_error(values: Values, targets: Targets) -> Loss:
    """Half the mean squared error, summed over critics."""
    return 0.5 * jnp.sum(jnp.mean((values - targets[None]) ** 2, (1, 2)))


def min_q(values: Values) -> Float[Array, " batch"]:
    """Minimum over critics (SAC)."""
    return jnp.min(jnp.mean(values, -1), 0)


def mean_q(values: Values) -> Float[Array, " batch"]:
    """Mean over critics and quantiles (DroQ, TQC, BRO)."""
    return jnp.mean(values, (0, 2))


@dataclasses.dataclass(frozen=True)
class TruncatedQuantiles:
    """
    The quantiles of all critics in one pool, without its ``n_dropped * n_critics`` largest (TQC).
    Which critic these come from does not matter.

    :param n_dropped: per critic that there is
    """

    n_dropped: int

    def __call__(self, values: Values) -> Targets:
        together = jnp.concatenate(list(values), -1)
        if not self.n_dropped:
            return together
        rows = jax.lax.platform_dependent(together, cpu=sorted_by_columns, default=sorted_by_rows)
        return rows[:, : together.shape[-1] - self.n_dropped * values.shape[0]]


def sorted_by_columns(values: Float[Array, "batch n"]) -> Float[Array, "batch n"]:
    """
    Bitonic network (Batcher 1968) over whole columns, far faster on a CPU than ``jnp.sort`` of as
    many short rows. A NaN in a row makes NaN of all that it meets.
    """
    n, columns = values.shape[-1], values.T
    size = 1 << (n - 1).bit_length()
    columns = jnp.pad(columns, ((0, size - n), (0, 0)), constant_values=jnp.inf)
    for run in (2 << i for i in range(size.bit_length() - 1)):
        # Two sorted runs become one: the second backwards, then ever closer partners.
        first, second = jnp.split(columns.reshape(size // run, run, -1), 2, 1)
        second = second[:, ::-1]
        low, high = jnp.minimum(first, second), jnp.maximum(first, second)
        columns = jnp.concatenate([low, high[:, ::-1]], 1)
        apart = run // 4
        while apart:
            pairs = columns.reshape(size // (2 * apart), 2, apart, -1)
            columns = jnp.stack([pairs.min(1), pairs.max(1)], 1)
            apart //= 2
    return columns.reshape(size, -1)[:n].T


def sorted_by_rows(values: Float[Array, "batch n"]) -> Float[Array, "batch n"]:
    """``jnp.sort``, which puts a NaN last, where it might be left out: it makes NaN of its row."""
    unknown = jnp.isnan(values).any(-1, keepdims=True)
    return jnp.where(unknown, jnp.nan, jnp.sort(values, -1))


@jax.custom_jvp
def quantile_huber(values: Values, targets: Targets) -> Loss:
    """
    Mean over quantiles, targets and batch, summed over critics (Dabney et al. 2018). Targets count
    as constants: no gradient reaches them.

    Reverse mode would keep every pair of a quantile and a target; here, slopes are summed up beside
    the loss.
    """
    return _with_slope(values, targets)[0]


@quantile_huber.defjvp
def _(primals: tuple[Values, Targets], tangents: tuple[Values, Targets]) -> tuple[Loss, Loss]:
    loss, slope = _with_slope(*primals)
    return loss, jnp.sum(slope * tangents[0])


def _with_slope(values: Values, targets: Targets) -> tuple[Loss, Values]:
    """:return: the loss, and its slope in the values"""
    loss, slope = jax.lax.platform_dependent(
        values, targets, cpu=target_by_target, default=all_targets
    )
    n_pairs = targets.size * values.shape[-1]
    return jnp.sum(loss) / n_pairs, slope / n_pairs


def target_by_target(values: Values, targets: Targets) -> tuple[Values, Values]:
    """:return: losses and slopes of the values, summed over targets"""

    def add(sums: tuple[Values, Values], target: Float[Array, " batch"]) -> tuple[Any, None]:
        loss, slope = _of_pairs(values, target[:, None])
        return (sums[0] + loss, sums[1] + slope), None

    nothing = jnp.zeros_like(values), jnp.zeros_like(values)
    return jax.lax.scan(add, nothing, targets.T, unroll=4)[0]


def all_targets(values: Values, targets: Targets) -> tuple[Values, Values]:
    """:return: as ``target_by_target``, all pairs in one operation"""
    one = jax.vmap(_of_pairs, (None, -1), -1)
    loss, slope = one(values, targets[:, None])
    return jnp.sum(loss, -1), jnp.sum(slope, -1)


def _of_pairs(values: Values, target: Float[Array, "batch #values"]) -> tuple[Values, Values]:
    """:return: loss and slope of each value with one target of each row"""
    n = values.shape[-1]
    level = (jnp.arange(n) + 0.5) / n
    delta = target - values
    clipped = jnp.clip(delta, -1.0, 1.0)
    pull = jnp.where(delta < 0.0, 1.0 - level, level) * clipped
    return pull * (delta - 0.5 * clipped), -pull
