"""The policies of the SAC family, as SB3 sees them: a Gaussian actor and an ensemble of critics."""

import inspect
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule

from sb3_hds.algos.base.construct import between, check_count
from sb3_hds.algos.model_free.policy import LearningPolicy
from sb3_hds.algos.model_free.sac.update import (
    Learner,
    Recipe,
    act,
    begin,
    explored,
    judge,
    least,
    pessimistic,
    squared,
)
from sb3_hds.algos.nets.activations import Activation, activation, widths_of
from sb3_hds.algos.nets.heads import USUAL, Critic, ExploringActor, GaussianActor, noise_std
from sb3_hds.algos.nets.mlp import ORTHOGONAL, ORTHONORMAL, Mlp, SimbaBody
from sb3_hds.algos.nets.observations import Seen, flattener, seen, size_of
from sb3_hds.algos.nets.optimizers import Weights, optimizer_of
from sb3_hds.core.numerics.compilation import GENERATOR
from sb3_hds.deploy.policy_function import PolicyFunction

_OF_GSDE = ("log_std_init", "full_std", "use_expln", "clip_mean")
# Of the policy's constructor: what is no argument.
_NO_ARGUMENTS = ("self", "observation_space", "action_space", "__class__")


class GaussianPolicy(LearningPolicy):
    """
    ``"MlpPolicy"`` and ``"MultiInputPolicy"``: dense layers; without target entropy or rules of its
    own, so that every algorithm of the family can use it.

    :param observation_space: Box, Discrete, MultiDiscrete, MultiBinary, or a Dict of these, which
        are flattened, choices one-hot
    :param action_space: a bounded Box of any shape
    :param lr_schedule: learning rate by remaining progress
    :param net_arch: hidden widths of both, or ``{"pi": [...], "qf": [...]}``
    :param activation_fn: name, JAX function or torch module class
    :param n_critics: members of the ensemble
    :param n_quantiles: values of each of them
    :param dropout_rate: of the critics
    :param layer_norm: in the critics; the networks of SimBa and BRO have it in any case
    :param renorm_warmup_steps: batch normalisation in actor and critics, which becomes batch
        renormalisation after so many updates, and CrossQ's update, without target networks; None:
        neither, but 100,000 with ``CrossQPolicy``
    :param batch_norm_momentum: the share of its running statistics that stays at an update, as in
        SBX; SB3-contrib's ``batch_norm_momentum=0.01`` is 0.99 here
    :param ortho_init: whether layers start orthogonal, as in JAXRL's SAC, rather than as flax and
        SBX have it: with a gain of the square root of 2, and of 1 where the deviation is read off;
        ``"hidden"``: but the last ones. The networks of SimBa and BRO start as in their papers
    :param use_sde: generalised state-dependent exploration (Raffin et al., CoRL 2021)
    :param log_std_init: gSDE: where the logarithm of the noise matrix's deviation starts
    :param full_std: gSDE: one deviation for each feature and control, or for each feature
    :param use_expln: gSDE: slower growth than the exponential above 0
    :param clip_mean: gSDE: the mean is clipped to this before tanh; 0: not
    :param normalize_observations: by running mean and variance, inside the policy
    :param squash_log_std: whether the logarithm of the deviation of actions is squashed into
        [-10, 2] by tanh, not clipped to [-20, 2], which is not for gSDE; None: only in the policies
        of SimbaSAC and BRO
    :param optimizer_class: name or function of optax, with its defaults, or torch class, with those
        of torch
    :param optimizer_kwargs: besides the learning rate; torch's ``betas`` and ``alpha`` are
        understood
    :param qf_optimizer_kwargs: of the critics, where they differ
    :raises ValueError: for arguments out of range, and those that these networks do not use
    """

    held = ("target", "seen")
    learner: Learner
    defaults: ClassVar[Mapping[str, Any]] = {
        "net_arch": (256, 256),
        "optimizer_class": "adam",
        "normalize_observations": False,
        "squash_log_std": False,
        "renorm_warmup_steps": None,
    }
    #: arguments that these networks do not use
    unused: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: Sequence[int] | Mapping[str, Sequence[int]] | None = None,
        activation_fn: str | Activation | type = "relu",
        n_critics: int = 2,
        n_quantiles: int = 1,
        dropout_rate: float = 0.0,
        layer_norm: bool = False,
        renorm_warmup_steps: int | None = None,
        batch_norm_momentum: float = 0.99,
        ortho_init: bool | str = False,
        use_sde: bool = False,
        log_std_init: float = -3.0,
        full_std: bool = True,
        use_expln: bool = False,
        clip_mean: float = 2.0,
        normalize_observations: bool | None = None,
        squash_log_std: bool | None = None,
        optimizer_class: str | Callable[..., Any] | None = None,
        optimizer_kwargs: Mapping[str, Any] | None = None,
        qf_optimizer_kwargs: Mapping[str, Any] | None = None,
    ) -> None:
        self.arguments = {
            name: value for name, value in locals().items() if name not in _NO_ARGUMENTS
        }
        super().__init__(observation_space, action_space, squash_output=True)
        chosen = {
            name: self.defaults.get(name) if value is None else value
            for name, value in self.arguments.items()
        }
        check_count("n_critics", n_critics)
        check_count("n_quantiles", n_quantiles)
        if chosen["renorm_warmup_steps"] is not None:
            check_count("renorm_warmup_steps", chosen["renorm_warmup_steps"], 0)
        _check_settings(self.arguments)
        self._refuse_unused(has_batch_norm=chosen["renorm_warmup_steps"] is not None)
        self._warn_of_unused()
        if use_sde and squash_log_std:
            raise ValueError(
                f"policy_kwargs={{'squash_log_std': {squash_log_std!r}}}: with use_sde=True, the "
                "deviation of actions is that of a noise matrix, which nothing squashes. Leave out "
                "one of them."
            )
        net: Any = chosen["net_arch"]
        # Files say it, so that they do not depend on the default.
        self.arguments["net_arch"] = dict(net) if isinstance(net, Mapping) else net
        self.widths = widths(net, "qf")
        self.activation_fn = activation(activation_fn)
        self.dropout_rate, self.layer_norm = float(dropout_rate), layer_norm
        self.renorm_warmup_steps, self.batch_norm_momentum = (
            chosen["renorm_warmup_steps"],
            batch_norm_momentum,
        )
        self.ortho_init = ortho_init
        self.normalize_observations = bool(chosen["normalize_observations"])
        self.squash_log_std = bool(chosen["squash_log_std"]) and not use_sde
        self.n_critics, self.n_quantiles, self.use_sde = n_critics, n_quantiles, use_sde
        n_act = int(np.prod(action_space.shape))
        pi, qf = self.widths
        body = self.actor_body(pi)
        of_mean, of_std = self.last_layers()
        self.actor_network = GaussianActor(body, n_act, self.squash_log_std, of_mean, of_std)
        if use_sde:
            gsde = (log_std_init, full_std, use_expln, clip_mean, of_mean)
            self.actor_network = ExploringActor(body, n_act, *gsde)
        self.critic_network = Critic(self.critic_body(qf), n_quantiles, of_mean)
        own = dict(optimizer_kwargs or {})
        make: Any = chosen["optimizer_class"]
        usual = self.defaults.get("optimizer_kwargs", {}) if optimizer_class is None else {}
        self.optimizers = (
            optimizer_of(make, {**usual, **own}),
            optimizer_of(make, {**usual, **own, **dict(qf_optimizer_kwargs or {})}),
        )
        self.n_obs, self.n_act = size_of(observation_space), n_act
        self.flatten = flattener(observation_space)
        self.forget_noise()
        self._noise = np.random.default_rng(0)

    def _refuse_unused(self, has_batch_norm: bool) -> None:
        unused = self.unused if has_batch_norm else (*self.unused, "batch_norm_momentum")
        usual = inspect.signature(GaussianPolicy).parameters
        for name in unused:
            if self.arguments[name] != usual[name].default:
                raise ValueError(
                    f"policy_kwargs={{'{name}': {self.arguments[name]!r}}}: the networks of "
                    f"{type(self).__name__} do not use {name} here; leave it out."
                )

    def _warn_of_unused(self) -> None:
        usual = inspect.signature(GaussianPolicy).parameters
        idle = [name for name in _OF_GSDE if self.arguments[name] != usual[name].default]
        if idle and not self.arguments["use_sde"]:
            warnings.warn(f"{', '.join(idle)} in policy_kwargs say nothing without use_sde=True.")
        momentum = self.arguments["batch_norm_momentum"]
        if momentum < 0.5:
            warnings.warn(
                f"batch_norm_momentum={momentum} is the share of the running statistics that "
                "stays at an update, as in SBX. SB3-contrib's is the share of the new: pass "
                f"{1.0 - momentum:g} for its {momentum}."
            )

    def actor_body(self, net_arch: Sequence[int]) -> nn.Module:
        return Mlp(
            net_arch,
            self.activation_fn,
            renorm_warmup_steps=self.renorm_warmup_steps,
            momentum=self.batch_norm_momentum,
            ortho_init=bool(self.ortho_init),
        )

    def critic_body(self, net_arch: Sequence[int]) -> nn.Module:
        return Mlp(
            net_arch,
            self.activation_fn,
            self.dropout_rate,
            self.layer_norm,
            self.renorm_warmup_steps,
            self.batch_norm_momentum,
            bool(self.ortho_init),
        )

    def last_layers(self) -> tuple[nn.initializers.Initializer, nn.initializers.Initializer]:
        """:return: where they start: those of means and values, and those of deviations"""
        usual = self.ortho_init in (False, "hidden")
        return (USUAL, USUAL) if usual else (ORTHOGONAL, ORTHONORMAL)

    def build_plain(self) -> None:
        """That of SAC; with batch normalisation, that of CrossQ."""
        self.build(self.plain_recipe(), 1.0, 0, jax.devices()[0])

    def plain_recipe(self) -> Recipe:
        """:return: that of SAC with these networks; with batch normalisation, that of CrossQ"""
        return Recipe(
            actor=self.actor_network,
            critic=self.critic_network,
            n_critics=self.n_critics,
            target_of=least,
            error=squared,
            worth=pessimistic,
            optimizer=self.optimizers[0],
            qf_optimizer=self.optimizers[1],
            joint_pass=self.renorm_warmup_steps is not None,
            normalize=self.normalize_observations,
        )

    def build(self, recipe: Recipe, ent_coef: float, seed: int, device: Any) -> None:
        """
        Draw fresh networks.

        :param recipe: of the algorithm
        :param ent_coef: where the entropy coefficient starts
        """
        self.recipe = recipe
        key = jax.random.key(seed, impl=GENERATOR)
        self.learner = jax.device_put(begin(recipe, self.n_obs, self.n_act, ent_coef, key), device)
        self._draw_noise_by(seed)

    def observed(self, obs: np.ndarray | dict[str, np.ndarray]) -> None:
        """Count observations, of one step of every environment, among those seen."""
        if self.normalize_observations:
            scales = self.learner.seen.with_more(self.flatten(obs))
            self.learner = self.learner._replace(seen=scales)

    def critic(self, obs: Any, actions: Any) -> tuple[np.ndarray, ...]:
        learner, flat = self.learner, self.flatten(obs)
        taken = np.asarray(actions, np.float32).reshape(len(flat), -1)
        values = _judged(self.recipe, learner.critic.weights, learner.seen, flat, taken)
        return tuple(np.asarray(values))

    def reset_noise(self, batch_size: int = 1) -> None:
        """
        Draw a new noise matrix for each environment, where the policy explores by gSDE.

        :param batch_size: number of environments
        """
        if self.use_sde:
            std = np.asarray(noise_std(self.actor_network, self.learner.actor.weights))  # type: ignore[arg-type]
            drawn = self._noise.standard_normal((batch_size, *std.shape), np.float32)
            self.matrices = drawn * std

    def keep_noise(self, batch_size: int, n_steps: int) -> None:
        """
        Called at every step, noise matrices last ``n_steps`` steps, whatever was drawn in between.

        :param batch_size: number of environments
        """
        if self._age % n_steps == 0 or len(self._lasting) != batch_size:
            self.reset_noise(batch_size)
            self._lasting, self._age = self.matrices, 0
        self.matrices = self._lasting
        self._age += 1

    def set_random_seed(self, seed: int) -> None:
        super().set_random_seed(seed)
        self._draw_noise_by(seed)

    def _draw_noise_by(self, seed: int) -> None:
        self._noise = np.random.default_rng(seed)
        self.forget_noise()

    def forget_noise(self) -> None:
        self.matrices: Any = None
        self._lasting, self._age = self.matrices, 0

    def get_std(self) -> np.ndarray:
        """:return: standard deviation of the noise matrix's entries; 0 without gSDE"""
        if not self.use_sde:
            return np.zeros(1)
        return np.asarray(noise_std(self.actor_network, self.learner.actor.weights))  # type: ignore[arg-type]

    def policy_function(self) -> PolicyFunction:
        """:return: what the policy computes where nothing is explored, to be exported"""
        learner, scales = self.learner, None
        if self.normalize_observations:
            variance = np.asarray(learner.seen.variance)
            scales = np.asarray(learner.seen.mean), np.sqrt(variance)
        act = partial(_mean, self.actor_network, learner.actor.weights, learner.seen)
        return PolicyFunction.without_memory(act, squashed=True, scales=scales)

    def _predict(self, observation: Any, deterministic: bool = False) -> np.ndarray:  # type: ignore[override]
        obs, actor = self.flatten(observation), self.learner.actor.weights
        if deterministic:
            return np.asarray(_mean(self.actor_network, actor, self.learner.seen, obs))
        scales, extra = self.learner.seen, self.learner.extra
        if not self.use_sde:
            noise = self._noise.standard_normal((len(obs), self.n_act), np.float32)
            return np.asarray(_scattered(self.recipe, actor, extra, scales, obs, noise))
        if self.matrices is None:
            self.reset_noise()
        matrices: Any = self.matrices
        if len(matrices) != len(obs):
            matrices = matrices[:1]
        return np.asarray(_moved(self.recipe, actor, extra, scales, obs, matrices))


class SimbaPolicy(GaussianPolicy):
    """
    ``"SimbaPolicy"``: residual networks on observations normalised by running statistics (Lee et
    al., ICLR 2025), with the weight decay of the paper. Its critics have 512 units, which two cores
    do not bear: ``net_arch={"pi": [128], "qf": [512, 512]}``; the default has a quarter of them.

    What the algorithm samples from stays that of the algorithm: the logarithm of the deviation of
    actions is clipped, as in SBX, and starts near 0, which is what the first entropy coefficient of
    1 and the target entropies of TQC and DroQ are made for. ``squash_log_std=True`` makes it that
    of SimBa's authors.
    """

    defaults: ClassVar[Mapping[str, Any]] = {
        "net_arch": {"pi": (128,), "qf": (128, 128)},
        "optimizer_class": "adamw",
        "optimizer_kwargs": {"weight_decay": 1e-2},
        "normalize_observations": True,
    }
    unused = ("renorm_warmup_steps", "ortho_init")
    narrow = 128

    def actor_body(self, net_arch: Sequence[int]) -> nn.Module:
        return SimbaBody(net_arch, self.activation_fn)

    def critic_body(self, net_arch: Sequence[int]) -> nn.Module:
        return SimbaBody(net_arch, self.activation_fn, self.dropout_rate)


class SimbaSACPolicy(SimbaPolicy):
    """
    The policy of SimbaSAC: also what actions are drawn from is that of SimBa's authors, with
    ``squash_log_std=True`` where there is no gSDE, and so is where last layers start.
    """

    defaults = {**SimbaPolicy.defaults, "squash_log_std": True}

    def last_layers(self) -> tuple[nn.initializers.Initializer, nn.initializers.Initializer]:
        return ORTHONORMAL, ORTHONORMAL


class CrossQPolicy(GaussianPolicy):
    """
    Batch normalisation in actor and critics, and Adam's ``b1`` of 0.5 (Bhatt et al., ICLR 2024).
    Their critics have 2048 units, which two cores do not bear: ``net_arch={"pi": [256, 256], "qf":
    [2048, 2048]}``; the default has a quarter of them.
    """

    defaults = {
        "net_arch": {"pi": (256, 256), "qf": (512, 512)},
        "optimizer_class": "adam",
        "optimizer_kwargs": {"b1": 0.5},
        "normalize_observations": False,
        "renorm_warmup_steps": 100_000,
    }


def widths(
    net_arch: Sequence[int] | Mapping[str, Sequence[int]], critic: str
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """
    :param critic: the key of the critics' widths, where those of the actor differ
    :return: hidden widths of the actor and of the critics
    :raises ValueError: for other keys than ``pi`` and that one, or widths that are no counts
    """
    given = net_arch if isinstance(net_arch, Mapping) else {"pi": net_arch, critic: net_arch}
    pi, qf = (widths_of(given.get(name)) for name in ("pi", critic))
    if given.keys() != {"pi", critic} or pi is None or qf is None:
        raise ValueError(
            f"net_arch must be a list of widths such as [256, 256], or {{'pi': [256], '{critic}': "
            f"[256, 256]}}, got {net_arch!r}."
        )
    return pi, qf


def _check_settings(arguments: Mapping[str, Any]) -> None:
    ranges = {
        "batch_norm_momentum": (0.0, 1.0, "from 0 to 1: the share that stays at an update"),
        "log_std_init": (-math.inf, math.inf, "a finite number"),
        "clip_mean": (0.0, math.inf, "a number of at least 0; 0 does not clip"),
    }
    for name, (low, high, allowed) in ranges.items():
        if not between(arguments[name], low, high):
            raise ValueError(f"{name} must be {allowed}, got {arguments[name]!r}.")
    rate = arguments["dropout_rate"]
    if not (between(rate, 0.0, 1.0) and rate < 1.0):
        raise ValueError(f"dropout_rate must be at least 0 and below 1, got {rate!r}.")
    start = arguments["ortho_init"]
    if start not in (True, False, "hidden"):
        raise ValueError(f"ortho_init must be True, False or 'hidden', got {start!r}.")


@partial(jax.jit, static_argnums=0)
def _judged(recipe: Recipe, weights: Weights, scales: Seen, obs: Any, actions: Any) -> jax.Array:
    """Dropout, where there is some, is the same in each call."""
    inside = seen(scales, obs) if recipe.normalize else obs
    values, _ = judge(recipe, weights, inside, actions, jax.random.key(0))
    return jnp.mean(values, -1, keepdims=True)


@partial(jax.jit, static_argnums=0)
def _mean(actor: nn.Module, weights: Weights, scales: Seen, obs: Any) -> jax.Array:
    return jnp.tanh(act(actor, weights, seen(scales, obs))[0].mean)


@partial(jax.jit, static_argnums=0)
def _scattered(
    recipe: Recipe, weights: Weights, extra: Any, scales: Seen, obs: Any, noise: Any
) -> jax.Array:
    return explored(recipe, weights, extra, seen(scales, obs), lambda g: g.std * noise)


@partial(jax.jit, static_argnums=0)
def _moved(
    recipe: Recipe, weights: Weights, extra: Any, scales: Seen, obs: Any, matrices: Any
) -> jax.Array:
    """Every environment has its matrix; with one matrix, it is everybody's."""
    each = jnp.broadcast_to(matrices, (obs.shape[0], *matrices.shape[1:]))
    noise = lambda g: jnp.einsum("bl,bla->ba", g.latent, each)  # noqa: E731
    return explored(recipe, weights, extra, seen(scales, obs), noise)
