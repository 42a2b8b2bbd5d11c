"""BRO: large regularised critics, and an optimistic actor that explores."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_hds.algos.base.construct import between, is_count
from sb3_hds.algos.model_free.sac.algorithm import SoftActorCritic
from sb3_hds.algos.model_free.sac.policy import GaussianPolicy
from sb3_hds.algos.model_free.sac.quantiles import quantile_huber
from sb3_hds.algos.model_free.sac.update import (
    Batch,
    Knobs,
    Learner,
    Recipe,
    act,
    average,
    judge,
    mean,
)
from sb3_hds.algos.nets.dense import Last
from sb3_hds.algos.nets.mlp import ORTHOGONAL, ORTHONORMAL, BroBody, orthogonal
from sb3_hds.algos.nets.optimizers import Optimizer, Trained, Weights
from sb3_hds.algos.nets.squashed import Gaussian, squashed_between

# Steps of the environment at which the authors' networks start afresh: with the full replay ratio,
# and with the fast one of 2.
_RESETS = (15_000, 50_000, 250_000, 500_000, 750_000, 1_000_000, 1_500_000, 2_000_000)
_FAST, _FAST_RESETS = 2, _RESETS[:1]
_INITIAL_OPTIMISM, _INITIAL_REGULARIZER = 1.0, 0.25
# Of the logarithms of the multipliers.
_MULTIPLIER_LIMITS = (-10.0, 7.5)


class BroPolicy(GaussianPolicy):
    """
    BroNets of the paper's widths. Where it explores, it acts by the optimistic actor, where it does
    not, by the other one.
    """

    defaults = {
        "net_arch": {"pi": (256,), "qf": (512, 512)},
        "optimizer_class": "adamw",
        "optimizer_kwargs": {"weight_decay": 1e-4},
        "normalize_observations": False,
        "squash_log_std": True,
    }
    unused = ("renorm_warmup_steps", "dropout_rate", "ortho_init")
    narrow = 128

    def actor_body(self, net_arch: Sequence[int]) -> nn.Module:
        return BroBody(net_arch, self.activation_fn)

    def critic_body(self, net_arch: Sequence[int]) -> nn.Module:
        return BroBody(net_arch, self.activation_fn)

    def last_layers(self) -> tuple[nn.initializers.Initializer, nn.initializers.Initializer]:
        return ORTHOGONAL, ORTHONORMAL


class BRO(SoftActorCritic):
    r"""
    Bigger, regularised, optimistic: BroNet critics with 100 quantiles, whose **mean** is what both
    targets and actor go by, a second actor that explores where the critics disagree, and networks
    that start afresh.

    Source: Nauman et al., *Bigger, Regularized, Optimistic: scaling for compute and
    sample-efficient continuous control*, NeurIPS 2024: replay ratio 10 (``gradient_steps=10``; here
    2, their fast variant, which two cores bear), batches of 128, AdamW with 3e-4, target entropy of
    minus half the number of controls, Adam with b1 = 0.5 for the temperature and the multipliers.
    Their first values are no arguments (optimism 1, regulariser 0.25). As in the authors' code (MIT
    licence), fresh starts include the temperature, the multipliers and all optimisers, and the
    logarithms of multipliers and of the deviation of actions are squashed into their limits by
    :math:`\tanh`: actions start with a deviation near :math:`e^{-4}`, not near 1 as with SAC. Its
    quantile loss is a sum over quantiles where this is their mean, a factor that Adam takes out
    again. The loss of the entropy coefficient has the coefficient itself, as theirs. With
    ``use_sde=True``, which the paper does not have, the optimistic actor explores by gSDE's noise.
    SBX has no BRO.

    :param policy: see :class:`~sb3_hds.algos.model_free.sac.algorithm.SoftActorCritic`
    :param env: likewise
    :param learning_rate: of actor, entropy coefficient and critics; number, schedule or
        ``"lin_3e-4"``
    :param gradient_steps: updates per call of ``train``
    :param batch_size: transitions per update
    :param linear_ent_coef: whether the loss of the entropy coefficient has it itself
    :param kl_target: divergence of the optimistic actor from the other one, per control
    :param std_multiplier: its standard deviation, in units of the other one's
    :param multiplier_rate: learning rate of the multipliers, in units of ``learning_rate``, whose
        schedule it follows; 3e-5 by default
    :param param_resets: steps at which all networks start afresh; None: the paper's, of which only
        the first with ``gradient_steps`` of at most 2; ``[]``: never
    :param policy_kwargs: ``n_quantiles`` is 100 unless given
    :param arguments: those of ``SoftActorCritic``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": BroPolicy,
        "MultiInputPolicy": BroPolicy,
    }
    kept_by_restarts = ("seen", "n_updates")

    def __init__(
        self,
        policy: str | type[BasePolicy] | GymEnv = "MlpPolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | str | Schedule = 3e-4,
        *,
        gradient_steps: int = 2,
        batch_size: int = 128,
        linear_ent_coef: bool = True,
        kl_target: float = 0.05,
        std_multiplier: float = 0.75,
        multiplier_rate: float = 0.1,
        param_resets: list[int] | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        self.kl_target, self.std_multiplier = kl_target, std_multiplier
        self.multiplier_rate = multiplier_rate
        if param_resets is None:
            # -1: one for each step.
            fast = is_count(gradient_steps, -1) and gradient_steps <= _FAST
            param_resets = list(_FAST_RESETS if fast else _RESETS)
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            gradient_steps=gradient_steps,
            batch_size=batch_size,
            linear_ent_coef=linear_ent_coef,
            param_resets=param_resets,
            policy_kwargs={"n_quantiles": 100, **(policy_kwargs or {})},
            **arguments,
        )

    def check_arguments(self) -> None:
        super().check_arguments()
        for name in ("kl_target", "std_multiplier", "multiplier_rate"):
            fine = between(getattr(self, name), 0.0, math.inf)
            self.refuse_unless(fine, name, "a number of at least 0")

    def auto_target_entropy(self) -> float:
        return -0.5 * self.policy.n_act

    def recipe(self) -> Recipe:
        policy = self.policy
        optimist = Optimist(
            network=Shift(policy.actor_body(policy.widths[0]), policy.n_act),
            optimizer=policy.optimizers[0],
            kl_target=self.kl_target,
            std_multiplier=self.std_multiplier,
            multiplier_rate=self.multiplier_rate,
        )
        return dataclasses.replace(
            super().recipe(),
            target_of=average,
            error=quantile_huber,
            worth=mean,
            ent_coef_optimizer=_MULTIPLIER,
            extra=optimist,
        )


class Shift(nn.Module):
    """
    How far the optimistic actor's mean is from the other one's.

    :param body: see ``bodies.py``
    :param n_act: number of controls
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
class Optimist:
    r"""
    The actor that explores: it climbs :math:`Q_\mu + \beta\, Q_\sigma`, mean and half difference of
    the critics, and pays :math:`\tau` for its divergence from the other actor. Both multipliers
    follow the divergence that is aimed at (section 3 of the paper).

    :param network: a ``Shift``
    :param optimizer: of the shift
    :param kl_target: divergence, per control
    :param std_multiplier: its standard deviation, in units of the other one's
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
        fresh = {name: {"params": _before(math.log(start))} for name, start in multipliers.items()}
        return {"actor": Trained(weights, self.optimizer.init(weights["params"]))} | {
            name: Trained(raw, _MULTIPLIER.init(raw["params"])) for name, raw in fresh.items()
        }

    def update(
        self, recipe: Recipe, learner: Learner, batch: Batch, knobs: Knobs, key: PRNGKeyArray
    ) -> Any:
        act_key, judge_key = jax.random.split(key)
        state = learner.extra
        gaussian, _ = act(recipe.actor, learner.actor.weights, batch.obs)
        values = {n: _value(state[n].weights["params"]) for n in ("optimism", "regularizer")}
        noise = jax.random.normal(act_key, gaussian.mean.shape)

        def loss(params: Any) -> tuple[Array, Array]:
            shift = cast(Array, self.network.apply({"params": params}, batch.obs, gaussian.mean))
            std = self.std_multiplier * gaussian.std
            action = jnp.tanh(gaussian.mean + shift + std * noise)
            worth, _ = judge(recipe, learner.critic.weights, batch.obs, action, judge_key)
            apart = 0.5 * (worth.max(0) - worth.min(0))
            upper = worth.mean(0) + values["optimism"] * apart
            divergence = jnp.mean(jnp.sum(shift**2 / (2.0 * gaussian.std**2), -1))
            return values["regularizer"] * divergence - upper.mean(), divergence

        gradient = jax.value_and_grad(loss, has_aux=True)
        (_, divergence), slope = gradient(state["actor"].weights["params"])
        excess = divergence / gaussian.mean.shape[-1] - self.kl_target
        rate = self.multiplier_rate * knobs.learning_rate
        return {
            "actor": self.optimizer.apply(slope, state["actor"], knobs.learning_rate),
            "optimism": _following(state["optimism"], excess, rate),
            "regularizer": _following(state["regularizer"], -excess, rate),
        }

    def explore(self, state: Any, obs: Array, gaussian: Gaussian, apart: Array) -> Array:
        shift = cast(Array, self.network.apply(state["actor"].weights, obs, gaussian.mean))
        return jnp.tanh(gaussian.mean + shift + self.std_multiplier * apart)


def _value(raw: Array) -> Array:
    """Of a multiplier."""
    return jnp.exp(squashed_between(raw, *_MULTIPLIER_LIMITS))


def _before(log: float) -> Array:
    """:return: what is squashed into that logarithm of a multiplier"""
    low, high = _MULTIPLIER_LIMITS
    return jnp.asarray(math.atanh(2.0 * (log - low) / (high - low) - 1.0), jnp.float32)


def _following(multiplier: Trained, excess: Array, rate: Array | float) -> Trained:
    slope = jax.grad(lambda raw: excess * _value(raw))(multiplier.weights["params"])
    return _MULTIPLIER.apply(slope, multiplier, rate)


_MULTIPLIER = Optimizer(optax.adam, (("b1", 0.5),))
