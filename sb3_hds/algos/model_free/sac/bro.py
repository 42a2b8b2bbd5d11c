"""BRO: large regularised critics, and an optimistic actor that explores."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY
from typing import Any, ClassVar, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray
from stable_baselines3.common.policies import BasePolicy

from sb3_hds.algos.base.config import takes
from sb3_hds.algos.model_free.replay import Batch
from sb3_hds.algos.model_free.sac.algorithm import SACConfig, SoftActorCritic
from sb3_hds.algos.model_free.sac.networks import (
    ORTHOGONAL,
    ORTHONORMAL,
    Gaussian,
    Hidden,
    Last,
    orthogonal,
    squashed_between,
)
from sb3_hds.algos.model_free.sac.policy import GaussianPolicy, GaussianPolicyConfig
from sb3_hds.algos.model_free.sac.tqc import quantile_huber
from sb3_hds.algos.model_free.sac.update import (
    Hyperparams,
    SACState,
    UpdateConfig,
    forward,
    mean_q,
    mean_values,
    q_values,
)
from sb3_hds.algos.nets.optimizers import Optimizer, TrainState, Weights
from sb3_hds.algos.nets.options import Activation

# Environment steps at which the authors reset the networks: with the full replay ratio, and with
# the fast variant's ratio of 2.
_RESETS = (15_000, 50_000, 250_000, 500_000, 750_000, 1_000_000, 1_500_000, 2_000_000)
_FAST, _FAST_RESETS = 2, _RESETS[:1]
_INITIAL_OPTIMISM, _INITIAL_REGULARIZER = 1.0, 0.25
# Limits of the logarithms of the multipliers.
_MULTIPLIER_LIMITS = (-10.0, 7.5)


@dataclasses.dataclass(frozen=True, eq=False)
class BroPolicyConfig(GaussianPolicyConfig):
    """
    Arguments of ``BroPolicy``; the default optimiser is AdamW with the paper's weight decay.

    :param net_arch: ``{"pi": [256], "qf": [512, 512]}`` by default
    """

    net_arch: Sequence[int] | Mapping[str, Sequence[int]] = dataclasses.field(
        default_factory=lambda: {"pi": (256,), "qf": (512, 512)}
    )
    default_optimizer = ("adamw", {"weight_decay": 1e-4})
    default_squash_log_std = True
    unused = ("renorm_warmup_steps", "dropout_rate", "ortho_init")


class BroPolicy(GaussianPolicy):
    """
    BroNets of the paper's widths. Exploratory actions are the optimistic actor's, deterministic
    ones those of the (conservative) actor.
    """

    narrow = 128

    @takes(BroPolicyConfig)
    def __init__(self, config: BroPolicyConfig) -> None:
        self.construct(config)

    def actor_body(self, net_arch: Sequence[int]) -> nn.Module:
        return BroNet(net_arch, self.activation_fn)

    def critic_body(self, net_arch: Sequence[int]) -> nn.Module:
        return BroNet(net_arch, self.activation_fn)

    def last_layers(self) -> tuple[nn.initializers.Initializer, nn.initializers.Initializer]:
        return ORTHOGONAL, ORTHONORMAL


@dataclasses.dataclass(frozen=True, eq=False)
class BROConfig(SACConfig):
    """
    Arguments of BRO.

    :param kl_target: divergence of the optimistic actor from the actor, per action
    :param std_multiplier: standard deviation of the optimistic actor, in units of the actor's
    :param multiplier_rate: learning rate of the multipliers, in units of ``learning_rate``, whose
        schedule it follows; 3e-5 by default
    :param param_resets: steps at which all networks are reset; None: the paper's, with
        ``gradient_steps`` of at most 2 only the first of them; ``[]``: never
    :param policy_kwargs: ``n_quantiles`` is 100 by default; see
        :class:`~sb3_hds.algos.GaussianPolicy`
    """

    _: KW_ONLY
    gradient_steps: int = 2
    batch_size: int = 128
    linear_ent_coef: bool = True
    kl_target: float = 0.05
    std_multiplier: float = 0.75
    multiplier_rate: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        allowed = "a number of at least 0"
        names = ("kl_target", "std_multiplier", "multiplier_rate")
        self.require_range(0.0, math.inf, allowed, *names)


class BRO(SoftActorCritic):
    r"""
    Bigger, regularised, optimistic: BroNet critics with 100 quantiles, of which targets and actor
    use the **mean**; a second, optimistic actor that explores where the critics disagree; and
    resets of the networks.

    Source: Nauman et al., *Bigger, Regularized, Optimistic: scaling for compute and
    sample-efficient continuous control*, NeurIPS 2024: replay ratio 10 (``gradient_steps=10``; here
    2, their fast variant, which two cores can train), batches of 128, AdamW with 3e-4, target
    entropy of minus half the number of actions, Adam with b1 = 0.5 for the temperature and the
    multipliers, which start at 1 (optimism) and 0.25 (regulariser). As in the authors' code (MIT
    licence), resets include the temperature, the multipliers and all optimisers; :math:`\tanh`
    squashes the logarithms of the multipliers and ``log_std`` of the actions into their limits, so
    that the standard deviation starts near :math:`e^{-4}`, not near 1 as with SAC; and the loss of
    the entropy coefficient is linear in the coefficient. Their quantile loss is a sum over
    quantiles, here it is a mean; Adam cancels the factor. With ``use_sde=True``, which the paper
    does not have, the optimistic actor explores by gSDE's noise. SBX has no BRO.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": BroPolicy,
        "MultiInputPolicy": BroPolicy,
    }
    kept_by_resets = ("obs_stats", "n_updates")

    config_class = BROConfig
    default_policy_kwargs = {"n_quantiles": 100}

    @takes(BROConfig)
    def __init__(self, config: BROConfig) -> None:
        self.construct(config)

    def construct(self, config: BROConfig, **more: Any) -> None:  # type: ignore[override]
        if config.param_resets is None:
            # -1 means one update per step.
            resets = _FAST_RESETS if config.gradient_steps <= _FAST else _RESETS
            config = dataclasses.replace(config, param_resets=list(resets))
        super().construct(config, **more)

    def auto_target_entropy(self) -> float:
        return -0.5 * self.policy.n_act

    def make_update_config(self) -> UpdateConfig:
        policy, config = self.policy, self.config
        optimist = OptimisticActor(
            network=MeanShift(policy.actor_body(policy.widths[0]), policy.n_act),
            optimizer=policy.optimizers[0],
            kl_target=config.kl_target,
            std_multiplier=config.std_multiplier,
            multiplier_rate=config.multiplier_rate,
        )
        return dataclasses.replace(
            super().make_update_config(),
            target_values=mean_values,
            critic_loss=quantile_huber,
            actor_objective=mean_q,
            ent_coef_optimizer=_MULTIPLIER,
            extra=optimist,
        )


class BroNet(nn.Module):
    """
    Residual blocks with layer norm after each dense layer.

    Source: Nauman et al., *Bigger, Regularized, Optimistic: scaling for compute and
    sample-efficient continuous control*, NeurIPS 2024, section 3 (BroNet).

    :param net_arch: width of each block; a dense layer precedes a block of another width; empty:
        the identity
    :param activation_fn: between the layers
    """

    net_arch: Sequence[int]
    activation_fn: Activation

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n"], train: bool) -> Float[Array, "*batch m"]:
        dense = lambda width: Hidden(width, kernel_init=ORTHOGONAL)  # noqa: E731
        for i, width in enumerate(self.net_arch):
            if i == 0 or x.shape[-1] != width:
                x = self.activation_fn(nn.LayerNorm()(dense(width)(x)))
            inside = self.activation_fn(nn.LayerNorm()(dense(width)(x)))
            x = x + nn.LayerNorm()(dense(width)(inside))
        return x


class MeanShift(nn.Module):
    """
    Difference between the means of the optimistic actor and the actor.

    :param body: hidden layers
    :param n_act: number of actions
    """

    body: nn.Module
    n_act: int

    @nn.compact
    def __call__(
        self, obs: Float[Array, "*batch obs"], mean: Float[Array, "*batch act"]
    ) -> Float[Array, "*batch act"]:
        latent = self.body(jnp.concatenate([obs, mean], -1), False)
        small = orthogonal(0.01)
        return Last(self.n_act, use_bias=False, kernel_init=small)(latent)


@dataclasses.dataclass(frozen=True)
class OptimisticActor:
    r"""
    The actor that explores. It maximises :math:`Q_\mu + \beta\, Q_\sigma`, the mean and half the
    difference of the critics, minus :math:`\tau` times its divergence from the actor. The
    multipliers :math:`\beta` and :math:`\tau` are adapted to a target of the divergence (section 3
    of the paper).

    :param network: a ``MeanShift``
    :param optimizer: of the shift
    :param kl_target: divergence from the actor, per action
    :param std_multiplier: its standard deviation, in units of the actor's
    :param multiplier_rate: learning rate of the multipliers, in units of the actor's
    """

    network: nn.Module
    optimizer: Optimizer
    kl_target: float
    std_multiplier: float
    multiplier_rate: float

    def init(self, actor: Weights, obs: Array, key: PRNGKeyArray) -> Any:
        n_act = cast(Any, self.network).n_act
        weights = self.network.init(key, obs, jnp.zeros((1, n_act)))
        multipliers = {"optimism": _INITIAL_OPTIMISM, "regularizer": _INITIAL_REGULARIZER}
        return {"actor": self.optimizer.train_state(weights)} | {
            name: _MULTIPLIER.train_state({"params": _before(math.log(start))})
            for name, start in multipliers.items()
        }

    def update(
        self,
        config: UpdateConfig,
        state: SACState,
        batch: Batch,
        hyper: Hyperparams,
        key: PRNGKeyArray,
    ) -> Any:
        act_key, q_key = jax.random.split(key)
        own, critics = state.extra, state.critic.weights
        gaussian, _ = forward(config.actor, state.actor.weights, batch.obs)
        optimism, regularizer = (
            _multiplier(own[name].weights["params"]) for name in ("optimism", "regularizer")
        )
        noise = jax.random.normal(act_key, gaussian.mean.shape)

        def loss(params: Any) -> tuple[Array, Array]:
            shift = cast(Array, self.network.apply({"params": params}, batch.obs, gaussian.mean))
            std = self.std_multiplier * gaussian.std
            action = jnp.tanh(gaussian.mean + shift + std * noise)
            values, _ = q_values(config, critics, batch.obs, action, q_key)
            disagreement = 0.5 * (values.max(0) - values.min(0))
            upper = values.mean(0) + optimism * disagreement
            divergence = jnp.mean(jnp.sum(shift**2 / (2.0 * gaussian.std**2), -1))
            return regularizer * divergence - upper.mean(), divergence

        loss_and_gradient = jax.value_and_grad(loss, has_aux=True)
        (_, divergence), gradient = loss_and_gradient(own["actor"].weights["params"])
        excess = divergence / gaussian.mean.shape[-1] - self.kl_target
        rate = self.multiplier_rate * hyper.learning_rate
        return {
            "actor": self.optimizer.apply(gradient, own["actor"], hyper.learning_rate),
            "optimism": _adapted(own["optimism"], excess, rate),
            "regularizer": _adapted(own["regularizer"], -excess, rate),
        }

    def explore(self, state: Any, obs: Array, gaussian: Gaussian, noise: Array) -> Array:
        shift = cast(Array, self.network.apply(state["actor"].weights, obs, gaussian.mean))
        return jnp.tanh(gaussian.mean + shift + self.std_multiplier * noise)


def _multiplier(raw: Array) -> Array:
    """:return: the multiplier with this learned parameter"""
    return jnp.exp(squashed_between(raw, *_MULTIPLIER_LIMITS))


def _before(log: float) -> Array:
    """:return: the parameter that is squashed into this logarithm of a multiplier"""
    low, high = _MULTIPLIER_LIMITS
    return jnp.asarray(math.atanh(2.0 * (log - low) / (high - low) - 1.0), jnp.float32)


def _adapted(multiplier: TrainState, excess: Array, rate: Array | float) -> TrainState:
    gradient = jax.grad(lambda raw: excess * _multiplier(raw))(multiplier.weights["params"])
    return _MULTIPLIER.apply(gradient, multiplier, rate)


_MULTIPLIER = Optimizer(optax.adam, (("b1", 0.5),))
