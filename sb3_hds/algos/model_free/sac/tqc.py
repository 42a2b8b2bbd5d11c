"""TQC: quantile critics; the largest quantiles are dropped from the targets."""

import dataclasses
from dataclasses import KW_ONLY
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sb3_hds.algos.base.config import check_count, takes
from sb3_hds.algos.model_free.sac.algorithm import SACConfig, SoftActorCritic
from sb3_hds.algos.model_free.sac.update import Loss, Targets, UpdateConfig, Values, mean_q


@dataclasses.dataclass(frozen=True, eq=False)
class TQCConfig(SACConfig):
    """
    Arguments of TQC.

    :param top_quantiles_to_drop_per_net: quantiles per critic that are dropped from the targets,
        the largest of all critics' pooled quantiles
    :param policy_kwargs: ``n_quantiles`` is 25 by default; see
        :class:`~sb3_hds.algos.GaussianPolicy`
    """

    _: KW_ONLY
    top_quantiles_to_drop_per_net: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_counts({"top_quantiles_to_drop_per_net": 0})


class TQC(SoftActorCritic):
    """
    Truncated quantile critics.

    Source: Kuznetsov et al., *Controlling Overestimation Bias with Truncated Mixture of Continuous
    Distributional Quantile Critics*, ICML 2020: 25 quantiles, five critics of three layers of 512
    (``policy_kwargs={"n_critics": 5, "net_arch": {"pi": [256, 256], "qf": [512, 512, 512]}}``); 2
    quantiles per critic are dropped, none on HalfCheetah and 5 on Hopper; learning starts with the
    first full batch (``learning_starts=256``). The default of two critics is that of SB3-contrib
    and SBX.
    """

    config_class = TQCConfig
    default_policy_kwargs = {"n_quantiles": 25}

    @takes(TQCConfig)
    def __init__(self, config: TQCConfig) -> None:
        self.construct(config)

    def make_update_config(self) -> UpdateConfig:
        return dataclasses.replace(
            super().make_update_config(),
            target_values=TruncatedQuantiles(self.config.top_quantiles_to_drop_per_net),
            critic_loss=quantile_huber,
            actor_objective=mean_q,
        )

    def check_environment(self, config: Any) -> None:
        super().check_environment(config)
        n, n_quantiles = config.top_quantiles_to_drop_per_net, config.policy_kwargs["n_quantiles"]
        check_count("n_quantiles", n_quantiles)
        if n >= n_quantiles:
            raise ValueError(
                "top_quantiles_to_drop_per_net must be a whole number of at least 0 and below the "
                f"{n_quantiles} quantiles of a critic (policy_kwargs={{'n_quantiles': ...}}), got "
                f"{n!r}."
            )


@dataclasses.dataclass(frozen=True)
class TruncatedQuantiles:
    """
    The pooled quantiles of all critics without the ``n_dropped * n_critics`` largest.

    :param n_dropped: dropped quantiles per critic
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
    Bitonic sorting network (Batcher 1968) over whole columns, far faster on a CPU than ``jnp.sort``
    of as many short rows. A NaN in a row spreads to every entry that it is compared with.
    """
    n, columns = values.shape[-1], values.T
    size = 1 << (n - 1).bit_length()
    columns = jnp.pad(columns, ((0, size - n), (0, 0)), constant_values=jnp.inf)
    for run in (2 << i for i in range(size.bit_length() - 1)):
        # Merge two sorted runs: reverse the second, then compare partners at halving distances.
        first, second = jnp.split(columns.reshape(size // run, run, -1), 2, 1)
        second = second[:, ::-1]
        low, high = jnp.minimum(first, second), jnp.maximum(first, second)
        columns = jnp.concatenate([low, high[:, ::-1]], 1)
        distance = run // 4
        while distance:
            pairs = columns.reshape(size // (2 * distance), 2, distance, -1)
            columns = jnp.stack([pairs.min(1), pairs.max(1)], 1)
            distance //= 2
    return columns.reshape(size, -1)[:n].T


def sorted_by_rows(values: Float[Array, "batch n"]) -> Float[Array, "batch n"]:
    """``jnp.sort``, but a NaN makes its whole row NaN: sorted last, it might be dropped."""
    unknown = jnp.isnan(values).any(-1, keepdims=True)
    return jnp.where(unknown, jnp.nan, jnp.sort(values, -1))


@jax.custom_jvp
def quantile_huber(values: Values, targets: Targets) -> Loss:
    """
    Quantile Huber loss: mean over quantiles, targets and batch, summed over critics (Dabney et al.
    2018). Targets are constants: they receive no gradient.

    Reverse mode would store every pair of a quantile and a target; here, the slope is computed with
    the loss. Sorting and loss are written twice: a CPU walks through memory once, while on an
    accelerator, where every operation waits for the previous one, fewer operations are faster.
    """
    return _with_slope(values, targets)[0]


@quantile_huber.defjvp
def _(primals: tuple[Values, Targets], tangents: tuple[Values, Targets]) -> tuple[Loss, Loss]:
    loss, slope = _with_slope(*primals)
    return loss, jnp.sum(slope * tangents[0])


def _with_slope(values: Values, targets: Targets) -> tuple[Loss, Values]:
    """:return: the loss and its derivative by the values"""
    loss, slope = jax.lax.platform_dependent(
        values, targets, cpu=target_by_target, default=all_targets
    )
    n_pairs = targets.size * values.shape[-1]
    return jnp.sum(loss) / n_pairs, slope / n_pairs


def target_by_target(values: Values, targets: Targets) -> tuple[Values, Values]:
    """:return: losses and slopes of the values, summed over targets one by one (CPU)"""

    def add(sums: tuple[Values, Values], target: Float[Array, " batch"]) -> tuple[Any, None]:
        loss, slope = _of_pairs(values, target[:, None])
        return (sums[0] + loss, sums[1] + slope), None

    nothing = jnp.zeros_like(values), jnp.zeros_like(values)
    return jax.lax.scan(add, nothing, targets.T, unroll=4)[0]


def all_targets(values: Values, targets: Targets) -> tuple[Values, Values]:
    """:return: as ``target_by_target``, from all pairs at once (accelerators)"""
    one = jax.vmap(_of_pairs, (None, -1), -1)
    loss, slope = one(values, targets[:, None])
    return jnp.sum(loss, -1), jnp.sum(slope, -1)


def _of_pairs(values: Values, target: Float[Array, "batch #values"]) -> tuple[Values, Values]:
    """:return: loss and slope of each value for one target per row"""
    n = values.shape[-1]
    level = (jnp.arange(n) + 0.5) / n
    delta = target - values
    clipped = jnp.clip(delta, -1.0, 1.0)
    pull = jnp.where(delta < 0.0, 1.0 - level, level) * clipped
    return pull * (delta - 0.5 * clipped), -pull
