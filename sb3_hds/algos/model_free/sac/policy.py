"""Policies of the SAC family: a Gaussian actor and an ensemble of critics."""

import dataclasses
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from sb3_hds.algos.base.config import between, check_count, takes
from sb3_hds.algos.base.policy import LearningPolicy, PolicyConfig
from sb3_hds.algos.model_free.sac import networks
from sb3_hds.algos.model_free.sac.update import (
    UpdateConfig,
    explore,
    forward,
    init_state,
    min_q,
    min_values,
    q_values,
    squared_error,
)
from sb3_hds.algos.nets.observations import RunningStats, normalize
from sb3_hds.algos.nets.optimizers import Optimizer, Weights, optimizer_of
from sb3_hds.algos.nets.options import Activation, activation
from sb3_hds.core.numerics.compilation import GENERATOR
from sb3_hds.deploy.policy_function import PolicyFunction


@dataclasses.dataclass(frozen=True, eq=False)
class GaussianPolicyConfig(PolicyConfig):
    """
    Arguments of the policies of the SAC family.

    :param observation_space: Box, Discrete, MultiDiscrete, MultiBinary, or a Dict of these, which
        are flattened, choices one-hot
    :param action_space: a bounded Box of any shape
    :param net_arch: hidden widths of actor and critics, or ``{"pi": [...], "qf": [...]}``
    :param activation_fn: name, JAX function or torch module class
    :param n_critics: number of critics
    :param n_quantiles: values per critic
    :param dropout_rate: of the critics
    :param layer_norm: in the critics; the networks of SimBa and BRO always have it
    :param renorm_warmup_steps: use batch normalisation in actor and critics, which becomes batch
        renormalisation after this number of updates, and CrossQ's update without target networks;
        None: neither
    :param batch_norm_momentum: the share of the running statistics that an update keeps, as in SBX;
        SB3-contrib's ``batch_norm_momentum=0.01`` is 0.99 here
    :param ortho_init: whether layers start orthogonal, as in JAXRL's SAC, rather than with the
        initialisers of flax and SBX: with a gain of the square root of 2, of 1 in the layer of
        ``log_std``; ``"hidden"``: all but the last layers. SimBa and BRO start as in their papers.
    :param use_sde: generalised state-dependent exploration (gSDE; Raffin et al., CoRL 2021)
    :param log_std_init: gSDE: initial ``log_std`` of the noise matrix
    :param full_std: gSDE: one ``log_std`` per feature and action instead of one per feature
    :param use_expln: gSDE: slower growth than the exponential above 0
    :param clip_mean: gSDE: limit of the mean before tanh; 0: no limit
    :param normalize_observations: by running mean and variance, inside the policy
    :param squash_log_std: whether tanh squashes ``log_std`` of the actions into [-10, 2], instead
        of clipping it to [-20, 2]; not with gSDE; None: only in the policies of SimbaSAC and BRO
    :param optimizer_class: name or function of optax, with its defaults, or torch class, with
        torch's defaults
    :param optimizer_kwargs: besides the learning rate; may contain torch's ``betas`` and ``alpha``
    :param qf_optimizer_kwargs: of the critics, where they differ
    """

    net_arch: Sequence[int] | Mapping[str, Sequence[int]] = (256, 256)
    activation_fn: str | Activation | type = "relu"
    n_critics: int = 2
    n_quantiles: int = 1
    dropout_rate: float = 0.0
    layer_norm: bool = False
    renorm_warmup_steps: int | None = None
    batch_norm_momentum: float = 0.99
    ortho_init: bool | str = False
    use_sde: bool = False
    log_std_init: float = -3.0
    full_std: bool = True
    use_expln: bool = False
    clip_mean: float = 2.0
    normalize_observations: bool = False
    squash_log_std: bool | None = None
    optimizer_class: str | Callable[..., Any] | None = None
    optimizer_kwargs: Mapping[str, Any] | None = None
    qf_optimizer_kwargs: Mapping[str, Any] | None = None
    #: default optimiser and its arguments
    default_optimizer: ClassVar[tuple[str, Mapping[str, Any]]] = ("adam", {})
    #: default of ``squash_log_std``
    default_squash_log_std: ClassVar[bool] = False
    #: arguments that these networks do not have
    unused: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        """:raises ValueError: for arguments out of range, or that these networks do not have"""
        check_count("n_critics", self.n_critics)
        check_count("n_quantiles", self.n_quantiles)
        if self.renorm_warmup_steps is not None:
            check_count("renorm_warmup_steps", self.renorm_warmup_steps, 0)
        ranges = {
            "batch_norm_momentum": (0.0, 1.0, "from 0 to 1: the share that an update keeps"),
            "log_std_init": (-math.inf, math.inf, "a finite number"),
            "clip_mean": (0.0, math.inf, "a number of at least 0; 0 does not clip"),
        }
        for name, (low, high, allowed) in ranges.items():
            if not between(value := getattr(self, name), low, high):
                raise ValueError(f"{name} must be {allowed}, got {value!r}.")
        rate, ortho_init = self.dropout_rate, self.ortho_init
        if not (between(rate, 0.0, 1.0) and rate < 1.0):
            raise ValueError(f"dropout_rate must be at least 0 and below 1, got {rate!r}.")
        if ortho_init not in (True, False, "hidden"):
            raise ValueError(f"ortho_init must be True, False or 'hidden', got {ortho_init!r}.")
        fields = dataclasses.fields(self)
        given = {field.name for field in fields if getattr(self, field.name) != field.default}
        has_batch_norm = self.renorm_warmup_steps is not None
        for name in (*self.unused, *(() if has_batch_norm else ("batch_norm_momentum",))):
            if name in given:
                raise ValueError(
                    f"policy_kwargs={{'{name}': {getattr(self, name)!r}}}: the networks of "
                    f"{type(self).__name__.removesuffix('Config')} do not use {name} here; leave "
                    "it out."
                )
        idle = [
            name for name in ("log_std_init", "full_std", "use_expln", "clip_mean") if name in given
        ]
        if idle and not self.use_sde:
            warnings.warn(f"policy_kwargs {', '.join(idle)} have no effect without use_sde=True.")
        if (momentum := self.batch_norm_momentum) < 0.5:
            warnings.warn(
                f"batch_norm_momentum={momentum} is the share of the running statistics that an "
                "update keeps, as in SBX. In SB3-contrib, it is the share of the new ones: pass "
                f"{1.0 - momentum:g} for its {momentum}."
            )
        if self.use_sde and self.squash_log_std:
            raise ValueError(
                "policy_kwargs={'squash_log_std': True}: with use_sde=True, the standard deviation "
                "of actions is that of a noise matrix and not squashed. Leave out one of them."
            )

    def optimizers(self) -> tuple[Optimizer, Optimizer]:
        """:return: of the actor and of the critics"""
        make, usual = self.default_optimizer
        if self.optimizer_class is not None:
            make, usual = self.optimizer_class, {}
        own = {**usual, **(self.optimizer_kwargs or {})}
        of_critics = {**own, **(self.qf_optimizer_kwargs or {})}
        return optimizer_of(make, own), optimizer_of(make, of_critics)


class GaussianPolicy(LearningPolicy):
    """
    ``"MlpPolicy"`` and ``"MultiInputPolicy"``: dense layers, for every algorithm of the family.
    """

    saved_with_weights = ("target", "obs_stats")

    @takes(GaussianPolicyConfig)
    def __init__(self, config: GaussianPolicyConfig) -> None:
        self.construct(config)

    def construct(self, config: GaussianPolicyConfig) -> None:
        """Describe networks and optimisers; :meth:`build` initialises them."""
        super().__init__(config)
        pi, qf = self.widths
        self.config, self.use_sde = config, config.use_sde
        self.activation_fn = activation(config.activation_fn)
        self.normalize_observations = bool(config.normalize_observations)
        self.n_critics, self.n_quantiles = config.n_critics, config.n_quantiles
        body, (of_mean, of_std) = self.actor_body(pi), self.last_layers()
        if config.use_sde:
            gsde = (config.log_std_init, config.full_std, config.use_expln, config.clip_mean)
            self.actor_network = networks.ExploringActor(body, self.n_act, *gsde, of_mean)
        else:
            given = config.squash_log_std
            squash = config.default_squash_log_std if given is None else bool(given)
            self.actor_network = networks.GaussianActor(body, self.n_act, squash, of_mean, of_std)
        self.critic_network = networks.Critic(self.critic_body(qf), config.n_quantiles, of_mean)
        self.optimizers = config.optimizers()
        self._draw_noise_by(0)

    def actor_body(self, net_arch: Sequence[int]) -> nn.Module:
        return self._mlp(net_arch)

    def critic_body(self, net_arch: Sequence[int]) -> nn.Module:
        return self._mlp(net_arch, float(self.config.dropout_rate), self.config.layer_norm)

    def _mlp(
        self, net_arch: Sequence[int], dropout: float = 0.0, layer_norm: bool = False
    ) -> nn.Module:
        batch_norm = self.config.renorm_warmup_steps, self.config.batch_norm_momentum
        orthogonal = bool(self.config.ortho_init)
        return networks.Mlp(
            net_arch, self.activation_fn, dropout, layer_norm, *batch_norm, orthogonal
        )

    def last_layers(self) -> tuple[nn.initializers.Initializer, nn.initializers.Initializer]:
        """:return: initialisers of the layers of means and values, and of that of ``log_std``"""
        if self.config.ortho_init in (False, "hidden"):
            return networks.LECUN_NORMAL, networks.LECUN_NORMAL
        return networks.ORTHOGONAL, networks.ORTHONORMAL

    def build_default(self) -> None:
        """Initialise networks for SAC's update, or CrossQ's with batch normalisation."""
        self.build(self.default_update_config(), 1.0, 0, jax.devices()[0])

    def default_update_config(self) -> UpdateConfig:
        """:return: SAC's update with these networks, or CrossQ's with batch normalisation"""
        return UpdateConfig(
            actor=self.actor_network,
            critic=self.critic_network,
            n_critics=self.n_critics,
            target_values=min_values,
            critic_loss=squared_error,
            actor_objective=min_q,
            optimizer=self.optimizers[0],
            qf_optimizer=self.optimizers[1],
            joint_pass=self.config.renorm_warmup_steps is not None,
            normalize_observations=self.normalize_observations,
        )

    def build(self, config: UpdateConfig, ent_coef: float, seed: int, device: Any) -> None:
        """
        Initialise the networks.

        :param config: of the algorithm; the policy keeps it as ``update_config``
        :param ent_coef: initial entropy coefficient
        """
        self.update_config = config
        key = jax.random.key(seed, impl=GENERATOR)
        self.agent_state = jax.device_put(
            init_state(config, self.n_obs, self.n_act, ent_coef, key), device
        )
        self._draw_noise_by(seed)

    def update_obs_stats(self, obs: np.ndarray | dict[str, np.ndarray]) -> None:
        """Add observations of one step of every environment to the running statistics."""
        if self.normalize_observations:
            stats = self.agent_state.obs_stats.with_more(self.flatten(obs))
            self.agent_state = self.agent_state._replace(obs_stats=stats)

    def critic(self, obs: Any, actions: Any) -> tuple[np.ndarray, ...]:
        state, flat = self.agent_state, self.flatten(obs)
        taken = np.asarray(actions, np.float32).reshape(len(flat), -1)
        values = _q_values(self.update_config, state.critic.weights, state.obs_stats, flat, taken)
        return tuple(np.asarray(values))

    def reset_noise(self, batch_size: int = 1) -> None:
        """Draw a new noise matrix for each environment, if the policy explores by gSDE."""
        if self.use_sde:
            std = self.get_std()
            drawn = self._rng.standard_normal((batch_size, *std.shape), np.float32)
            self.matrices = drawn * std

    def noise_for_step(self, batch_size: int, n_steps: int) -> None:
        """
        To be called at every step: keep noise matrices for ``n_steps`` steps, also if SB3 draws
        others in between.

        :param batch_size: number of environments
        """
        if self._age % n_steps == 0 or len(self._kept_matrices) != batch_size:
            self.reset_noise(batch_size)
            self._kept_matrices, self._age = self.matrices, 0
        self.matrices = self._kept_matrices
        self._age += 1

    def set_random_seed(self, seed: int) -> None:
        super().set_random_seed(seed)
        self._draw_noise_by(seed)

    def _draw_noise_by(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self.discard_noise()

    def discard_noise(self) -> None:
        self.matrices: Any = None
        self._kept_matrices, self._age = self.matrices, 0

    def get_std(self) -> np.ndarray:
        """:return: standard deviation of each entry of the noise matrix; 0 without gSDE"""
        if not self.use_sde:
            return np.zeros(1)
        return np.asarray(networks.noise_std(self.actor_network, self.agent_state.actor.weights))  # type: ignore[arg-type]

    def policy_function(self) -> PolicyFunction:
        """:return: the deterministic policy, to be exported"""
        state, scales = self.agent_state, None
        if self.normalize_observations:
            stats = state.obs_stats
            scales = np.asarray(stats.mean), np.sqrt(np.asarray(stats.variance))
        act = partial(_deterministic, self.actor_network, state.actor.weights, state.obs_stats)
        return PolicyFunction.without_memory(act, squashed=True, scales=scales)

    def _predict(self, observation: Any, deterministic: bool = False) -> np.ndarray:  # type: ignore[override]
        obs, state = self.flatten(observation), self.agent_state
        actor, stats = state.actor.weights, state.obs_stats
        if deterministic:
            return np.asarray(_deterministic(self.actor_network, actor, stats, obs))
        if self.use_sde:
            if self.matrices is None:
                self.reset_noise()
            matrices: Any = self.matrices
            noise = matrices if len(matrices) == len(obs) else matrices[:1]
        else:
            noise = self._rng.standard_normal((len(obs), self.n_act), np.float32)
        return np.asarray(_exploratory(self.update_config, actor, state.extra, stats, obs, noise))


@dataclasses.dataclass(frozen=True, eq=False)
class SimbaPolicyConfig(GaussianPolicyConfig):
    """
    Arguments of ``SimbaPolicy``; the default optimiser is AdamW with the paper's weight decay.

    :param net_arch: a quarter of the paper's width, ``{"pi": [128], "qf": [128, 128]}`` by default
    """

    net_arch: Sequence[int] | Mapping[str, Sequence[int]] = dataclasses.field(
        default_factory=lambda: {"pi": (128,), "qf": (128, 128)}
    )
    normalize_observations: bool = True
    default_optimizer = ("adamw", {"weight_decay": 1e-2})
    unused = ("renorm_warmup_steps", "ortho_init")


class SimbaPolicy(GaussianPolicy):
    """
    ``"SimbaPolicy"``: residual networks on observations normalised by running statistics (Lee et
    al., ICLR 2025), with the paper's weight decay. The default critics have 128 units per layer, a
    quarter of the paper's (``net_arch={"pi": [128], "qf": [512, 512]}``), so that two cores can
    train them.

    The action distribution remains the algorithm's: ``log_std`` is clipped, as in SBX, and starts
    near 0, for which the initial entropy coefficient of 1 and the target entropies of TQC and DroQ
    are chosen. ``squash_log_std=True`` is the distribution of SimBa's authors.
    """

    narrow = 128

    @takes(SimbaPolicyConfig)
    def __init__(self, config: SimbaPolicyConfig) -> None:
        self.construct(config)

    def actor_body(self, net_arch: Sequence[int]) -> nn.Module:
        return networks.SimbaNet(net_arch, self.activation_fn)

    def critic_body(self, net_arch: Sequence[int]) -> nn.Module:
        return networks.SimbaNet(net_arch, self.activation_fn, float(self.config.dropout_rate))


@partial(jax.jit, static_argnums=0)
def _q_values(
    config: UpdateConfig, weights: Weights, stats: RunningStats, obs: Any, actions: Any
) -> jax.Array:
    """Every call draws the same dropout masks."""
    values, _ = q_values(config, weights, normalize(stats, obs), actions, jax.random.key(0))
    return jnp.mean(values, -1, keepdims=True)


@partial(jax.jit, static_argnums=0)
def _deterministic(actor: nn.Module, weights: Weights, stats: RunningStats, obs: Any) -> jax.Array:
    return jnp.tanh(forward(actor, weights, normalize(stats, obs))[0].mean)


@partial(jax.jit, static_argnums=0)
def _exploratory(
    config: UpdateConfig, weights: Weights, extra: Any, stats: RunningStats, obs: Any, noise: Any
) -> jax.Array:
    """
    :param noise: standard normal, shape ``(batch, act)``; with gSDE a noise matrix for each
        environment or one for all, shape ``(batch or 1, latent, act)``
    """

    def deviation(gaussian: networks.Gaussian) -> jax.Array:
        if noise.ndim == 2:
            return gaussian.std * noise
        each = jnp.broadcast_to(noise, (obs.shape[0], *noise.shape[1:]))
        return jnp.einsum("bl,bla->ba", gaussian.latent, each)

    return explore(config, weights, extra, normalize(stats, obs), deviation)
