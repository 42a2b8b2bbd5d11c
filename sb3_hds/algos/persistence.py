"""
Weights as tensors inside SB3's own zip format, so that a saved model outlives the JAX that wrote it.

SB3 saves every attribute that an algorithm lists in ``_get_torch_save_params`` by its ``state_dict``, and
reads it back with ``torch.load(weights_only=True)``. A policy built on :class:`TensorPolicy` answers that
protocol for its pytrees; nothing of JAX or Flax is pickled.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch as th
from sbx.common.policies import BaseJaxPolicy


def to_state_dict(tree: Any) -> dict[str, th.Tensor]:
    """:return: one tensor for each leaf, under its path in the pytree, in the order of the leaves"""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {_name(path): th.as_tensor(np.array(leaf)) for path, leaf in leaves}


def from_state_dict(tree: Any, tensors: dict[str, th.Tensor], strict: bool = True) -> Any:
    """
    :param tree: a pytree of the wanted structure; gives shapes and dtypes
    :param tensors: what :func:`to_state_dict` made of such a pytree
    :param strict: whether names must match exactly; otherwise missing leaves keep their value
    :return: the pytree with the tensors' values
    :raises RuntimeError: for missing or unexpected names, or another shape; as torch does
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(tree)
    expected = {_name(path): leaf for path, leaf in leaves}
    missing, unexpected = expected.keys() - tensors.keys(), tensors.keys() - expected.keys()
    if strict and (missing or unexpected):
        raise RuntimeError(
            f"The saved weights do not fit this network: missing {sorted(missing)}, "
            f"unexpected {sorted(unexpected)}. Was it built with other policy_kwargs?"
        )
    values = []
    for name, leaf in expected.items():
        if name in tensors and tuple(tensors[name].shape) != np.shape(leaf):
            raise RuntimeError(
                f"The saved weight '{name}' has shape {tuple(tensors[name].shape)}, this network "
                f"needs {np.shape(leaf)}. Was it built with other policy_kwargs?"
            )
        value = tensors[name].cpu().numpy() if name in tensors else leaf
        on_host = isinstance(leaf, np.ndarray)
        values.append(value if on_host else jnp.asarray(value, dtype=leaf.dtype))
    return jax.tree_util.tree_unflatten(structure, values)


class TensorPolicy(BaseJaxPolicy):
    """
    A policy whose networks are pytrees, saved as tensors.

    Subclasses implement ``weights`` and ``training_state``, each with a setter.
    """

    @property
    def weights(self) -> Any:
        """The pytree that prediction needs."""
        raise AttributeError("weights")

    @weights.setter
    def weights(self, tree: Any) -> None:
        raise AttributeError("weights")

    @property
    def training_state(self) -> Any:
        """The pytree that only training needs: optimiser states, counters, random keys as integers."""
        raise AttributeError("training_state")

    @training_state.setter
    def training_state(self, tree: Any) -> None:
        raise AttributeError("training_state")

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, th.Tensor]:
        return to_state_dict(self.weights)

    def load_state_dict(self, state_dict: dict, strict: bool = True, assign: bool = False) -> None:
        self.weights = from_state_dict(self.weights, state_dict, strict)


class TrainingTensors:
    """
    What SB3 takes for the optimiser of a policy: an object with ``state_dict`` and ``load_state_dict``.

    :param policy: whose training state is saved
    """

    def __init__(self, policy: TensorPolicy) -> None:
        self._policy = policy

    def state_dict(self) -> dict[str, th.Tensor]:
        return to_state_dict(self._policy.training_state)

    def load_state_dict(self, state_dict: dict[str, th.Tensor], strict: bool = True) -> None:
        self._policy.training_state = from_state_dict(
            self._policy.training_state, state_dict, strict
        )


def _name(path: tuple) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")
