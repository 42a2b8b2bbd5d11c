"""The policy of TD7, as SB3 sees it."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule

from sb3_hds.algos.base.construct import check_count
from sb3_hds.algos.model_free.policy import LearningPolicy
from sb3_hds.algos.model_free.sac.policy import widths
from sb3_hds.algos.model_free.td7.update import (
    Actor,
    Checkpoint,
    Critic,
    Encoder,
    Learner,
    Recipe,
    act,
    begin,
    embed,
    judge,
)
from sb3_hds.algos.nets.activations import Activation, activation
from sb3_hds.algos.nets.observations import flattener, size_of
from sb3_hds.algos.nets.optimizers import optimizer_of
from sb3_hds.core.numerics.compilation import GENERATOR
from sb3_hds.deploy.policy_function import PolicyFunction

# Of the policy's constructor: what is no argument.
_NO_ARGUMENTS = ("self", "observation_space", "action_space", "__class__", "use_sde")


class TD7Policy(LearningPolicy):
    """
    ``"MlpPolicy"`` of TD7: encoder, actor and two critics. Where nothing is explored, the policy
    of the last checkpoint acts, once one was kept.

    :param observation_space: a Box, or choices, which become one-hot
    :param action_space: a bounded Box of any shape
    :param lr_schedule: learning rate by remaining progress
    :param net_arch: hidden widths of all, or ``{"pi": [...], "qf": [...]}``
    :param embedding_size: of states, and of pairs of state and action
    :param activation_fn: of the actor: name, JAX function or torch module class
    :param qf_activation_fn: of encoder and critics
    :param n_critics: members of the ensemble
    :param optimizer_class: name or function of optax, with its defaults, or torch class, with those
        of torch
    :param optimizer_kwargs: besides the learning rate
    :param use_sde: accepted for SB3's sake; the policy is deterministic
    :raises ValueError: for arguments out of range
    """

    held = ("copies", "checkpoint")
    learner: Learner

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: Sequence[int] | Mapping[str, Sequence[int]] = (256, 256),
        embedding_size: int = 256,
        activation_fn: str | Activation | type = "relu",
        qf_activation_fn: str | Activation | type = "elu",
        n_critics: int = 2,
        optimizer_class: str | Callable[..., Any] = "adam",
        optimizer_kwargs: Mapping[str, Any] | None = None,
        use_sde: bool = False,
    ) -> None:
        self.arguments = {
            name: value for name, value in locals().items() if name not in _NO_ARGUMENTS
        }
        super().__init__(observation_space, action_space, squash_output=True)
        check_count("n_critics", n_critics)
        check_count("embedding_size", embedding_size)
        self.widths = pi, qf = widths(net_arch, "qf")
        of_values = activation(qf_activation_fn)
        self.n_obs = size_of(observation_space)
        self.action_shape = action_space.shape
        self.n_act = int(np.prod(self.action_shape))
        optimizer = optimizer_of(optimizer_class, optimizer_kwargs or {})
        self.parts: dict[str, Any] = {
            "encoder": Encoder(embedding_size, qf, of_values),
            "actor": Actor(self.n_act, pi, activation(activation_fn)),
            "critic": Critic(qf, of_values),
            "n_critics": n_critics,
            "optimizer": optimizer,
            "qf_optimizer": optimizer,
        }
        self.flatten = flattener(observation_space)

    def build_plain(self) -> None:
        """That of the paper."""
        self.build(Recipe(**self.parts), 0, jax.devices()[0])

    def build(self, recipe: Recipe, seed: int, device: Any) -> None:
        """
        Draw fresh networks.

        :param recipe: of the algorithm
        """
        self.recipe = recipe
        key = jax.random.key(seed, impl=GENERATOR)
        self.learner = jax.device_put(begin(recipe, self.n_obs, self.n_act, key), device)

    @property
    def has_checkpoint(self) -> bool:
        """Whether a checkpoint was kept, which then acts where nothing is explored."""
        return float(self.learner.checkpoint.kept) > 0.0

    def keep_checkpoint(self) -> None:
        """The policy as it is acts from now on where nothing is explored."""
        learner = self.learner
        checkpoint = Checkpoint(learner.copies.encoder, learner.actor.weights, jnp.ones(()))
        self.learner = learner._replace(checkpoint=checkpoint)

    def drop_checkpoint(self) -> None:
        """The policy as it is at the time acts, explored or not."""
        checkpoint = self.learner.checkpoint._replace(kept=jnp.zeros(()))
        self.learner = self.learner._replace(checkpoint=checkpoint)

    def policy_function(self) -> PolicyFunction:
        """:return: what the policy computes where nothing is explored, to be exported"""
        act = partial(_act, self.recipe, *self._acting(deterministic=True))
        return PolicyFunction.without_memory(act, squashed=True)

    def _predict(self, observation: Any, deterministic: bool = False) -> np.ndarray:  # type: ignore[override]
        weights = self._acting(deterministic)
        return np.asarray(_act(self.recipe, *weights, self.flatten(observation)))

    def _acting(self, deterministic: bool) -> tuple[Any, Any]:
        """Weights of the encoder and of the actor."""
        learner = self.learner
        if deterministic and self.has_checkpoint:
            return learner.checkpoint.encoder, learner.checkpoint.actor
        return learner.copies.encoder, learner.actor.weights

    def critic(self, obs: Any, actions: Any) -> tuple[np.ndarray, ...]:
        learner, flat = self.learner, self.flatten(obs)
        taken = np.asarray(actions, np.float32).reshape(len(flat), -1)
        values = _judged(self.recipe, learner.copies.encoder, learner.critic.weights, flat, taken)
        return tuple(np.asarray(values)[..., None])

    def reset_noise(self, batch_size: int = 1) -> None:
        """Nothing to reset: noise is added to the actions (``action_noise``)."""


@partial(jax.jit, static_argnums=0)
def _judged(recipe: Recipe, encoder: Any, critic: Any, obs: Any, actions: Any) -> jax.Array:
    return judge(recipe, critic, obs, actions, *embed(recipe, encoder, obs, actions))


@partial(jax.jit, static_argnums=0)
def _act(recipe: Recipe, encoder: Any, actor: Any, obs: Any) -> jax.Array:
    return act(recipe, encoder, actor, obs)
