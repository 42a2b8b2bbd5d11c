"""
Loading a policy from an untrusted file: nothing is unpickled.

SB3 pickles the parts of a model that are not JSON, such as its spaces, so that loading a model may
run code of whoever saved it. Our models also describe their policy in plain JSON; the weights are
tensors, which ``torch.load(weights_only=True)`` reads.
"""

import io
import json
import os
import zipfile
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import FloatSchedule

from sb3_hds.algos import registry
from sb3_hds.algos.base.files import damaged, existing, name_of, refuse_damaged
from sb3_hds.algos.base.policy import TensorPolicy
from sb3_hds.algos.nets.options import ACTIVATIONS, activation, name_in

# Arguments of policies that only learning needs.
_OF_LEARNING = ("lr_schedule", "optimizer_class", "optimizer_kwargs", "qf_optimizer_kwargs")


def described(policy: TensorPolicy) -> dict[str, Any] | None:
    """
    :return: JSON data from which ``load_policy`` builds the policy, without its weights; None for a
        class, a space or an activation that JSON cannot name
    """
    name = registry.registered_name(type(policy))
    if name is None:
        return None
    arguments = {
        name: name_in(ACTIVATIONS, activation(value)) if name.endswith("activation_fn") else value
        for name, value in policy.arguments.items()
        if name not in _OF_LEARNING
    }
    try:
        description = {
            "class": name,
            "observation_space": space_to_plain(policy.observation_space),
            "action_space": space_to_plain(policy.action_space),
            "arguments": arguments,
        }
        return json.loads(json.dumps(description, default=_plain))
    except TypeError:
        return None


def space_to_plain(space: spaces.Space) -> dict[str, Any]:
    """
    :return: JSON data that :func:`space_from_plain` understands
    :raises TypeError: for a space that none of our policies has
    """
    match space:
        case spaces.Box():
            limits = {"low": space.low.tolist(), "high": space.high.tolist()}
            return {"kind": "Box", "dtype": space.dtype.str, **limits}
        case spaces.Discrete():
            return {"kind": "Discrete", "n": int(space.n), "start": int(space.start)}
        case spaces.MultiDiscrete():
            counts = {"nvec": space.nvec.tolist(), "start": space.start.tolist()}
            return {"kind": "MultiDiscrete", **counts}
        case spaces.MultiBinary():
            return {"kind": "MultiBinary", "n": np.asarray(space.n).tolist()}
        case spaces.Dict():
            parts = {name: space_to_plain(part) for name, part in space.spaces.items()}
            return {"kind": "Dict", "spaces": parts}
    raise TypeError(f"No policy here has a {type(space).__name__}.")


def space_from_plain(plain: Mapping[str, Any]) -> spaces.Space:
    """
    :return: the space that :func:`space_to_plain` described
    :raises KeyError: for other data
    """
    match plain["kind"]:
        case "Box":
            dtype: Any = np.dtype(plain["dtype"])
            low, high = (np.array(plain[limit], dtype) for limit in ("low", "high"))
            return spaces.Box(low, high, dtype=dtype.type)
        case "Discrete":
            return spaces.Discrete(plain["n"], start=plain["start"])
        case "MultiDiscrete":
            return spaces.MultiDiscrete(np.array(plain["nvec"]), start=np.array(plain["start"]))
        case "MultiBinary":
            return spaces.MultiBinary(plain["n"])
        case "Dict":
            parts = {name: space_from_plain(part) for name, part in plain["spaces"].items()}
            # A dictionary would be sorted, which reorders the flat observation.
            return spaces.Dict(list(parts.items()))  # type: ignore[arg-type]
    raise KeyError(plain["kind"])


def _plain(value: Any) -> Any:
    """
    :return: a NumPy number or array as a Python number or list
    :raises TypeError: for anything else
    """
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is no plain data.")


def load_policy(path: str | os.PathLike[str] | io.BufferedIOBase) -> TensorPolicy:
    """
    Load the policy of a saved model on the CPU, to act with ``policy.predict(obs,
    deterministic=True)``.

    Nothing is unpickled, so the file need not be trusted. The policy has no environment and no
    ``VecNormalize`` (whose statistics are a separate file), and cannot continue learning. With
    ``deterministic=False``, BRO's policy draws from its actor, not from the optimistic one.

    :param path: of a zip file that one of our algorithms saved; ``.zip`` may be left out
    :return: a policy with ``predict``, without an optimiser
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: for a file that is damaged, that another library saved, or whose policy has
        a class or an activation function of your own
    """
    refuse_damaged(path, "data", "policy.pth")
    with zipfile.ZipFile(existing(path)) as file:
        content, tensors = file.read("data"), io.BytesIO(file.read("policy.pth"))
    try:
        description = json.loads(content).get("policy_description")
    # An untrusted file may hold anything, nested to any depth.
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
    # For a damaged file, torch raises many types of errors, some of which recommend unpickling.
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
        no_rate = FloatSchedule(0.0)
        policy = make(observation_space, action_space, lr_schedule=no_rate, **arguments)  # type: ignore[call-arg]
    # With arguments of an untrusted file, a constructor may raise anything.
    except Exception as error:
        raise ValueError(
            f"This file describes its policy in a way that this version does not know "
            f"({type(error).__name__}: {error}): it is damaged, or a newer one saved it."
        ) from error
    return policy


def _cpu() -> Any:
    """:return: the CPU, or the first device if ``JAX_PLATFORMS`` excludes the CPU"""
    try:
        return jax.devices("cpu")[0]
    except RuntimeError:
        return jax.devices()[0]
