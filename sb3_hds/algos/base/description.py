"""What a policy is, in plain data: a file says it without pickling anything."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_hds.algos import registry
from sb3_hds.algos.base.policy import TensorPolicy
from sb3_hds.algos.nets.activations import activation, activation_name

# Arguments of policies that prediction does not need: they say how to learn.
_OF_LEARNING = ("lr_schedule", "optimizer_class", "optimizer_kwargs", "qf_optimizer_kwargs")


def described(policy: TensorPolicy) -> dict[str, Any] | None:
    """
    :return: plain data from which ``load_policy`` builds the policy, without its weights; None for
        a class, a space or an activation that only Python knows
    """
    name = registry.registered_name(type(policy))
    if name is None:
        return None
    arguments = {
        name: activation_name(activation(value)) if name.endswith("activation_fn") else value
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
            # Sorted names would be another order of a flat observation.
            return spaces.Dict(list(parts.items()))  # type: ignore[arg-type]
    raise KeyError(plain["kind"])


def _plain(value: Any) -> Any:
    """
    :return: a number or an array of NumPy as Python has it
    :raises TypeError: for anything else
    """
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is no plain data.")
