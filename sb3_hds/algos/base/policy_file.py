"""
A policy from a file that a stranger sent: nothing in it is unpickled.

SB3 pickles whatever of a model is not JSON, its spaces among it, so that loading a model runs code
of whoever saved it. Beside that, our models describe their policy in plain JSON; the weights are
tensors, which ``torch.load(weights_only=True)`` reads.
"""

import io
import json
import os
import zipfile
from collections.abc import Mapping
from typing import Any

import jax
import torch as th

from sb3_hds.algos import registry
from sb3_hds.algos.base.description import space_from_plain
from sb3_hds.algos.base.files import damaged, existing, name_of, refuse_damaged
from sb3_hds.algos.base.policy import TensorPolicy


def load_policy(path: str | os.PathLike[str] | io.BufferedIOBase) -> TensorPolicy:
    """
    The policy of a saved model, on the CPU, to act with: ``policy.predict(obs,
    deterministic=True)``.

    Nothing is unpickled: the file may come from anywhere. It has no environment, no
    ``VecNormalize`` (whose statistics are a file of their own) and cannot go on learning. That of
    BRO draws from its plain actor with ``deterministic=False``, not from the optimistic one.

    :param path: of a zip file that one of our algorithms saved; ``.zip`` may be left out
    :return: a policy with ``predict``, and no optimiser
    :raises FileNotFoundError: if there is none
    :raises ValueError: for a file that is damaged, that another library saved, or whose policy only
        Python code describes: a class or an activation function of your own
    """
    refuse_damaged(path, "data", "policy.pth")
    with zipfile.ZipFile(existing(path)) as file:
        content, tensors = file.read("data"), io.BytesIO(file.read("policy.pth"))
    try:
        description = json.loads(content).get("policy_description")
    # Whatever a stranger wrote there, however deep it is nested.
    except (AttributeError, ValueError, RecursionError) as error:
        raise damaged(path, error) from error
    if description is None:
        raise ValueError(
            f"{name_of(path)} does not describe its policy in plain data: another library saved "
            "it, or its policy has a class or function of your own. "
            "If you trust whoever saved it, load it with its algorithm, for example HDS.load(path)."
        )
    policy = _built(description)
    policy.move_to(_cpu())
    try:
        policy.load_state_dict(th.load(tensors, map_location="cpu", weights_only=True))
    # What torch raises for a damaged file has many types, and recommends to unpickle it.
    except Exception as error:
        raise ValueError(
            f"{name_of(path)} has weights that are damaged, or do not fit the policy that it "
            f"describes ({type(error).__name__}): copy it once more from where it was saved."
        ) from None
    return policy


def _built(description: Mapping[str, Any]) -> TensorPolicy:
    try:
        make = registry.load(description["class"])
        observation_space = space_from_plain(description["observation_space"])
        action_space: Any = space_from_plain(description["action_space"])
        arguments = description["arguments"]
        policy = make(observation_space, action_space, lr_schedule=_no_rate, **arguments)  # type: ignore[call-arg]
    # Whatever a constructor makes of numbers that a stranger wrote.
    except Exception as error:
        raise ValueError(
            f"This file describes its policy in a way that this version does not know "
            f"({type(error).__name__}: {error}): it is damaged, or a newer one saved it."
        ) from error
    return policy


def _cpu() -> Any:
    """:return: where ``JAX_PLATFORMS`` leaves out the CPU, the first device that there is"""
    try:
        return jax.devices("cpu")[0]
    except RuntimeError:
        return jax.devices()[0]


def _no_rate(_: float) -> float:
    return 0.0
