"""The metadata of an exported file."""

import contextlib
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium import spaces

from sb3_hds.deploy.conversion import OPSET
from sb3_hds.deploy.observations import SINGLE, Port, parts_of
from sb3_hds.deploy.onnx_policy import METADATA, VERSION
from sb3_hds.deploy.plan import Plan
from sb3_hds.errors import ExportError, SB3HDSError

_VERSIONS = ("sb3-hds", "jax", "flax", "torch", "stable-baselines3", "sbx-rl", "jax2onnx", "onnx")


def metadata_of(
    plan: Plan,
    model: Any,
    env: gymnasium.Env | None,
    dt: float | None,
    ports: Mapping[str, Port],
    outputs: Sequence[str],
) -> dict[str, Any]:
    channels, actuators = _channels_and_actuators(plan, model, env)
    return {
        "version": VERSION,
        "algorithm": type(model).__name__,
        "observations": {
            port.name: channels.get(key) or _numbered(key, port)
            for key, port in ports.items()
            if key in parts_of(plan.stack.observation_space)
        },
        "actions": actuators,
        "dt": _dt(plan, model, env) if dt is None else float(dt),
        "inputs": [_described(port) for port in ports.values()],
        "outputs": list(outputs),
        "memory": [
            {
                "input": part.name,
                "output": f"next_{part.name}",
                "initial": np.asarray(part.initial, float).tolist(),
            }
            for part in plan.memory
        ],
        "joints": None if plan.joints is None else plan.joints._asdict(),
        "normalized": bool(plan.by),
        "layers": [type(layer.transform).__name__ for layer in plan.stack.layers],
        "outside": list(plan.stack.outside),
        "opset": OPSET,
        "weights_sha256": _hash(plan.policy),
        "versions": _versions(),
    }


def _described(port: Port) -> str:
    shape = ", ".join(map(str, ("batch", *port.shape)))
    return f"{port.name} {port.dtype} ({shape})"


def _numbered(key: str, port: Port) -> list[dict[str, str]]:
    name = key or "obs"
    names = [f"{name}[{i}]" for i in range(math.prod(port.shape))] if port.shape else [name]
    return [{"name": name, "unit": ""} for name in names]


def _channels_and_actuators(
    plan: Plan, model: Any, env: gymnasium.Env | None
) -> tuple[dict[str, list[dict[str, str]]], list[dict[str, Any]]]:
    """Channels and actuators, with names and units of the twin if there is one that fits."""
    space, twin = plan.stack.action_space, _twin(model, env)
    channels = {}
    if twin is not None and spaces.flatdim(plan.stack.observation_space) == len(twin.channels):
        channels[SINGLE] = [{"name": c.name, "unit": c.unit} for c in twin.channels]
    match space:
        case spaces.Box():
            n = spaces.flatdim(space)
            names, units = [f"action[{i}]" for i in range(n)], [""] * n
            if twin is not None and len(twin.actuators) == n:
                names, units = [a.name for a in twin.actuators], [a.unit for a in twin.actuators]
            ends = (
                [float(x) if math.isfinite(x) else None for x in end.ravel()]
                for end in (space.low, space.high)
            )
            return channels, [
                {"name": name, "unit": unit, "low": low, "high": high}
                for name, unit, low, high in zip(names, units, *ends, strict=True)
            ]
        case spaces.Discrete():
            return channels, [{"name": "action", "n": int(space.n), "start": int(space.start)}]
        case spaces.MultiDiscrete():
            choices = enumerate(zip(space.nvec.ravel(), space.start.ravel(), strict=True))
            return channels, [
                {"name": f"action[{i}]", "n": int(n), "start": int(start)}
                for i, (n, start) in choices
            ]
    raise ExportError(f"Actions of this kind cannot be exported: {space}.")


def _twin(model: Any, env: gymnasium.Env | None) -> Any:
    from sb3_hds import twins

    if getattr(model, "twin", None) is not None and env is None:
        return model.twin
    if env is None or env.spec is None:
        return None
    try:
        return twins.from_env(env.unwrapped)
    except SB3HDSError:
        return None


def _dt(plan: Plan, model: Any, env: gymnasium.Env | None) -> float | None:
    from sb3_hds.wrappers.interval import interval_of

    for layer in plan.stack.layers:
        if hasattr(layer.transform, "dt"):
            return float(layer.transform.dt)  # type: ignore[attr-defined]
    for holder in (plan.policy, model):
        inner = getattr(holder, "robot", None) or getattr(holder, "twin", None)
        if getattr(inner, "dt", None):
            return float(inner.dt)  # type: ignore[union-attr]
    try:
        return None if env is None else interval_of(env, ExportError)
    except ExportError:
        return None


def _hash(policy: Any) -> str:
    """Hash of all weights, ordered by name."""
    found = hashlib.sha256()
    for name, tensor in sorted(_tensors(policy).items()):
        found.update(name.encode())
        found.update(np.ascontiguousarray(np.asarray(tensor)).tobytes())
    return found.hexdigest()


def _tensors(policy: Any) -> dict[str, Any]:
    for holder in ("actor_state", "qf_state"):
        if hasattr(policy, holder):
            leaves, _ = jax.tree_util.tree_flatten_with_path(getattr(policy, holder).params)
            return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
    return {name: value.cpu() for name, value in policy.state_dict().items()}


def _versions() -> dict[str, str]:
    from importlib.metadata import PackageNotFoundError, version

    found = {}
    for name in _VERSIONS:
        # A checkout on the path has no version, nor does a library that is not installed.
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def prune(proto: Any) -> None:
    """Remove constants that no operation reads, of which runtimes warn."""
    read = {name for node in proto.graph.node for name in node.input}
    kept = [part for part in proto.graph.initializer if part.name in read]
    del proto.graph.initializer[:]
    proto.graph.initializer.extend(kept)


def write_metadata(proto: Any, metadata: Mapping[str, Any]) -> None:
    del proto.metadata_props[:]
    entry = proto.metadata_props.add()
    entry.key, entry.value = METADATA, json.dumps(metadata)
    proto.producer_name = "sb3_hds"
