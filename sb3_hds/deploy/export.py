"""From a policy to an ONNX file that computes the same, checked before it is written."""

import dataclasses
import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from sb3_hds.core.trajectories.storage import write_bytes
from sb3_hds.deploy.conversion import IR_VERSION, OPSET, Port, from_jax, from_torch
from sb3_hds.deploy.layers import Layer, Stack, stack_of
from sb3_hds.deploy.normalization import (
    WHOLE,
    Normalization,
    load_vec_normalize,
    normalizations,
)
from sb3_hds.deploy.onnx_policy import METADATA, VERSION, OnnxPolicy
from sb3_hds.deploy.policy_function import Joints, Memory, PolicyFunction
from sb3_hds.deploy.ports import drawn, flat, normalized, observation_ports, parts_of
from sb3_hds.errors import ExportError, SB3HDSError

#: observations on which a file and its policy are compared
N_CHECKED = 1_000
#: largest difference, in halves of the range of each action, or in its units where it has no limits
TOLERANCE = 1e-5
_VERSIONS = ("sb3-hds", "jax", "flax", "torch", "stable-baselines3", "sbx-rl", "jax2onnx", "onnx")


@dataclasses.dataclass(frozen=True)
class Exported:
    """
    What was written.

    :param path: of the file
    :param n_bytes: its size
    :param largest_error: of the actions on ``n_checked`` observations, in halves of their ranges
    :param metadata: what the file says of itself
    """

    path: Path
    n_bytes: int
    largest_error: float
    n_checked: int
    metadata: Mapping[str, Any]

    def __str__(self) -> str:
        told = self.metadata
        lines = [
            f"{self.path}: {self.n_bytes / 1024:.1f} KiB, opset {told['opset']}",
            f"  in:  {', '.join(told['inputs'])}",
            f"  out: {', '.join(told['outputs'])}",
            f"  {self.n_checked:,} observations: actions differ from predict by at most "
            f"{self.largest_error:.1e} of half their range",
        ]
        if told["outside"]:
            lines.append(f"  not in the file, needed where it runs: {', '.join(told['outside'])}")
        return "\n".join(lines)


class _Plan(NamedTuple):
    """
    What a file computes.

    :param policy: of SB3's kind
    :param function: what it computes; None for one of torch
    :param stack: what lies between it and the environment
    :param by: normalisation of the observations that it sees
    """

    policy: Any
    function: PolicyFunction | None
    stack: Stack
    by: Mapping[str, Normalization]

    @property
    def memory(self) -> tuple[Memory, ...]:
        own = self.function.memory if self.function else ()
        return (*own, *(Memory(layer.name, layer.memory) for layer in self.stack.layers))

    @property
    def joints(self) -> Joints | None:
        """Those of the innermost that reads some."""
        layers = (layer.joints for layer in reversed(self.stack.layers) if layer.joints)
        return next(layers, self.function.joints if self.function else None)


def export_onnx(
    model: Any,
    path: str | os.PathLike[str],
    *,
    env: gymnasium.Env | None = None,
    layers: bool = True,
    normalize: Any = None,
    dt: float | None = None,
    observations: np.ndarray | Mapping[str, np.ndarray] | None = None,
) -> Exported:
    """
    Write what a policy computes with ``deterministic=True``, from the observation of the
    environment to its command: normalisation, network, squashing and scaling are inside, and so are
    those layers around the environment that :mod:`sb3_hds.wrappers` can write as functions
    (:class:`~sb3_hds.wrappers.CPGPrior`, filters), with their memory as inputs and outputs.

    The file is written after it has answered 1,000 observations as ``predict`` does.

    :param model: of ours, of SBX or of Stable-Baselines3, or a policy alone, as from
        :func:`~sb3_hds.load_policy`
    :param path: a file of that name is replaced
    :param env: as the policy was trained in, with its wrappers; default: the model's own
    :param layers: whether wrappers go into the file; without, they are needed where it runs
    :param normalize: a ``VecNormalize``, or the path of its file, which is unpickled; default: that
        around the model's environment
    :param dt: how long a step is [s]; default: as the environment says
    :param observations: to compare on, with a leading axis; default: drawn, 1,000
    :return: what was written
    :raises ExportError: for a policy that cannot be exported, or whose file computes something else
    :raises OSError: if the file cannot be written; an older one is then left as it was
    """
    policy = getattr(model, "policy", model)
    function = _function_of(policy)
    if isinstance(normalize, str | os.PathLike):
        normalize = load_vec_normalize(normalize)
    if normalize is None and hasattr(model, "get_vec_normalize_env"):
        normalize = model.get_vec_normalize_env()
    env = env if env is not None else _first_env(model)
    stack = Stack((), policy.observation_space, policy.action_space, ())
    if env is not None:
        stack = _fitting(stack_of(env, layers), env, policy)
    plan = _Plan(policy, function, stack, normalizations(normalize))
    ports = _ports(plan)
    outputs = ["action", *(f"next_{part.name}" for part in plan.memory)]
    if plan.function is None:
        if stack.layers:
            raise ExportError(
                f"{stack.layers[0].name} around the environment goes into the file with policies "
                "of JAX only, and this one is of torch: export with layers=False, and wrap the "
                "environment where the file runs."
            )
        from sb3_hds.deploy.torch_policy import module_of

        proto = from_torch(module_of(policy, list(ports.values()), plan.by), _all(ports), outputs)
    else:
        inlined = bool(plan.memory) or not hasattr(policy, "policy_function")
        computed = partial(_computed, plan, tuple(ports))
        proto = from_jax(computed, _all(ports), outputs, inlined=inlined)
    proto.ir_version = IR_VERSION
    _prune(proto)
    told = _told(plan, model, env, dt, ports, outputs)
    _write(proto, told)
    given = _given(plan, observations)
    error = _largest_error(plan, OnnxPolicy(proto.SerializeToString()), given)
    n = len(next(iter(given.values())))
    if not error <= TOLERANCE:
        raise ExportError(
            f"The file would not compute what the policy does: on {n:,} observations, actions "
            f"differ by {error:.1e} of half their range, and {TOLERANCE:g} is allowed. Nothing was "
            "written. Observations far larger than their standard deviation lose their digits: "
            "pass observations=, measured ones, to compare on."
        )
    told["checked"] = {"n": n, "largest_error": error}
    _write(proto, told)
    content = proto.SerializeToString()
    return Exported(write_bytes(path, content), len(content), error, n, told)


def _first_env(model: Any) -> gymnasium.Env | None:
    """Of a model, the first copy of its environment, where it is in this process."""
    vec_env = getattr(model, "env", None)
    envs = getattr(getattr(vec_env, "unwrapped", vec_env), "envs", None)
    return envs[0] if isinstance(envs, Sequence) and len(envs) else None


def _fitting(stack: Stack, env: gymnasium.Env, policy: Any) -> Stack:
    """
    :raises ExportError: for an environment that the policy was not trained in
    """
    seen, commanded = env.observation_space, env.action_space
    fits = spaces.flatdim(seen) == spaces.flatdim(policy.observation_space)
    if not fits or commanded.shape != policy.action_space.shape:
        raise ExportError(
            f"The policy sees {policy.observation_space} and acts in {policy.action_space}, but "
            f"the environment has {seen} and {commanded}. Pass env= with all wrappers of the "
            "training."
        )
    if stack.layers:
        return stack
    return stack._replace(
        observation_space=policy.observation_space, action_space=policy.action_space
    )


def _function_of(policy: Any) -> PolicyFunction | None:
    """
    :raises ExportError: for a policy of another kind
    """
    from stable_baselines3.common.policies import BasePolicy

    if hasattr(policy, "policy_function"):
        return policy.policy_function()
    from sbx.common.policies import BaseJaxPolicy

    if isinstance(policy, BaseJaxPolicy):

        def of_one(obs: Any) -> Any:
            return policy._predict(obs[None], deterministic=True)[0]

        # Distributions of TensorFlow Probability refuse a batch of unknown size.
        return PolicyFunction.without_memory(jax.vmap(of_one), squashed=policy.squash_output)
    if not isinstance(policy, BasePolicy):
        raise ExportError(
            f"A model or a policy of ours, of SBX or of Stable-Baselines3 can be exported, got "
            f"{type(policy).__name__}."
        )
    if hasattr(policy, "lstm_actor"):
        raise ExportError("Recurrent policies of sb3-contrib cannot be exported.")
    return None


def _ports(plan: _Plan) -> dict[str, Port]:
    """Inputs, by the key of an observation, or by their own names."""
    double = bool(plan.memory)
    kind = "float64" if double else "float32"
    ports = observation_ports(plan.stack.observation_space, double)
    if plan.joints is not None:
        n = len(plan.joints.position)
        for name in ("joint_position", "joint_velocity"):
            ports[name] = Port(name, (n,), kind)
    for part in plan.memory:
        ports[part.name] = Port(part.name, part.initial.shape, kind)
    return ports


def _all(ports: Mapping[str, Port]) -> list[Port]:
    return list(ports.values())


def _computed(plan: _Plan, names: tuple[str, ...], *inputs: Any) -> tuple[Any, ...]:
    """What the file computes, of arrays of JAX with a leading axis."""
    assert plan.function is not None
    named = dict(zip(names, inputs, strict=True))
    observed = {key: named[key] for key in parts_of(plan.stack.observation_space)}
    joints = ()
    if plan.joints is not None:
        joints = named["joint_position"], named["joint_velocity"]
    memory = tuple(named[part.name] for part in plan.memory)
    n_own = len(plan.function.memory)
    own, held = memory[:n_own], memory[n_own:]
    below: list[Any] = []
    for layer, remembered in reversed(list(zip(plan.stack.layers, held, strict=True))):
        below.insert(0, observed[WHOLE])
        if layer.transform.observed:
            observed = {WHOLE: jnp.concatenate([observed[WHOLE], remembered], -1)}
    seen = {key: normalized(values, plan.by.get(key)) for key, values in observed.items()}
    action, own = plan.function.act(flat(plan.policy.observation_space, seen), joints, own)
    action = _in_units(action, plan.policy.action_space, plan.function.squashed)
    after = []
    for layer, obs, remembered in zip(plan.stack.layers, below, held, strict=True):
        act, read = jax.vmap(partial(_commanded, layer)), joints if layer.joints else ()
        action, remembered = act(action, obs, remembered, *read)
        after.append(remembered)
    if isinstance(plan.stack.action_space, spaces.Box):
        action = action.astype(jnp.float32)
    return (action, *own, *after)


def _in_units(action: Any, space: spaces.Space, squashed: bool) -> Any:
    if not isinstance(space, spaces.Box):
        return action.reshape(-1, *space.shape)  # type: ignore[misc]
    low, high = space.low, space.high
    action = action.reshape(-1, *space.shape)
    if squashed:
        action = low + 0.5 * (jnp.clip(action, -1.0, 1.0) + 1.0) * (high - low)
    return jnp.clip(action, low, high) if _limited(space) else action


def _limited(space: spaces.Box) -> bool:
    return bool(np.isfinite(space.low).any() or np.isfinite(space.high).any())


def _commanded(layer: Layer, action: Any, obs: Any, memory: Any, *joints: Any) -> tuple[Any, Any]:
    """What a layer makes of one action, of JAX or of NumPy."""
    rhythm: Any = layer.transform
    if layer.joints is None:
        return rhythm.act(action, obs, memory, layer.below)
    chosen = action.clip(-1.0, 1.0)
    target, after = rhythm.target(chosen, memory)
    command = rhythm.command(chosen, target, *joints)
    return command.clip(*layer.below.limits()), after


# --- what the file says of itself


def _told(
    plan: _Plan,
    model: Any,
    env: gymnasium.Env | None,
    dt: float | None,
    ports: Mapping[str, Port],
    outputs: Sequence[str],
) -> dict[str, Any]:
    channels, actuators = _named(plan, model, env)
    return {
        "version": VERSION,
        "algorithm": type(model).__name__,
        "observations": {
            port.name: channels.get(key) or _numbered(key, port)
            for key, port in ports.items()
            if key in parts_of(plan.stack.observation_space)
        },
        "actions": actuators,
        "dt": _interval(plan, model, env) if dt is None else float(dt),
        "inputs": [_spelt(port) for port in ports.values()],
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


def _spelt(port: Port) -> str:
    shape = ", ".join(map(str, ("batch", *port.shape)))
    return f"{port.name} {port.dtype} ({shape})"


def _numbered(key: str, port: Port) -> list[dict[str, str]]:
    name = key or "obs"
    names = [f"{name}[{i}]" for i in range(math.prod(port.shape))] if port.shape else [name]
    return [{"name": name, "unit": ""} for name in names]


def _named(
    plan: _Plan, model: Any, env: gymnasium.Env | None
) -> tuple[dict[str, list[dict[str, str]]], list[dict[str, Any]]]:
    """Channels and actuators, with the names and units of the twin where there is one that fits."""
    space, twin = plan.stack.action_space, _twin(model, env)
    channels = {}
    if twin is not None and spaces.flatdim(plan.stack.observation_space) == len(twin.channels):
        channels[WHOLE] = [{"name": c.name, "unit": c.unit} for c in twin.channels]
    match space:
        case spaces.Box():
            n = spaces.flatdim(space)
            names, units = [f"action[{i}]" for i in range(n)], [""] * n
            if twin is not None and len(twin.actuators) == n:
                names, units = [a.name for a in twin.actuators], [a.unit for a in twin.actuators]
            ends = zip(names, units, space.low.ravel(), space.high.ravel(), strict=True)
            return channels, [
                {
                    "name": name,
                    "unit": unit,
                    "low": _finite(float(low)),
                    "high": _finite(float(high)),
                }
                for name, unit, low, high in ends
            ]
        case spaces.Discrete():
            return channels, [{"name": "action", "n": int(space.n), "start": int(space.start)}]
        case spaces.MultiDiscrete():
            counts = enumerate(space.nvec.ravel())
            return channels, [{"name": f"action[{i}]", "n": int(n), "start": 0} for i, n in counts]
    raise ExportError(f"Actions of this kind cannot be exported: {space}.")


def _finite(limit: float) -> float | None:
    return limit if math.isfinite(limit) else None


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


def _interval(plan: _Plan, model: Any, env: gymnasium.Env | None) -> float | None:
    from sb3_hds.wrappers.interval import interval_of

    for layer in plan.stack.layers:
        if hasattr(layer.transform, "dt"):
            return float(layer.transform.dt)  # type: ignore[attr-defined]
    for holder in (plan.policy, model):
        inner = getattr(holder, "body", None) or getattr(holder, "twin", None)
        if getattr(inner, "dt", None):
            return float(inner.dt)  # type: ignore[union-attr]
    try:
        return None if env is None else interval_of(env, ExportError)
    except ExportError:
        return None


def _hash(policy: Any) -> str:
    """Of all weights, in their order, by name."""
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
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # a checkout on the path, or a library that is not used
            continue
    return found


def _prune(proto: Any) -> None:
    """Remove constants that no operation reads: runtimes warn of them."""
    read = {name for node in proto.graph.node for name in node.input}
    kept = [part for part in proto.graph.initializer if part.name in read]
    del proto.graph.initializer[:]
    proto.graph.initializer.extend(kept)


def _write(proto: Any, told: Mapping[str, Any]) -> None:
    del proto.metadata_props[:]
    entry = proto.metadata_props.add()
    entry.key, entry.value = METADATA, json.dumps(told)
    proto.producer_name = "sb3_hds"


# --- whether it computes what the policy does


def _given(plan: _Plan, observations: Any) -> dict[str, np.ndarray]:
    space = plan.stack.observation_space
    if observations is None:
        scales = {key: (by.mean, by.scale) for key, by in plan.by.items()}
        known = plan.function.scales if plan.function else None
        if known is not None and not scales and isinstance(space, spaces.Box):
            scales = {WHOLE: tuple(np.reshape(part, space.shape) for part in known)}
        if plan.stack.layers:
            scales = {}
        return drawn(space, N_CHECKED, scales, np.random.default_rng(0))  # type: ignore[arg-type]
    given = observations if isinstance(observations, Mapping) else {WHOLE: observations}
    if given.keys() != parts_of(space).keys():
        raise ExportError(f"observations must have the parts {list(parts_of(space))}.")
    found = {}
    for key, values in given.items():
        values = np.asarray(values)
        found[key] = values.astype(np.float32) if values.dtype.kind == "f" else values
    return found


def _largest_error(plan: _Plan, exported: OnnxPolicy, given: Mapping[str, np.ndarray]) -> float:
    """
    All at once where there is no memory, otherwise as one episode, so that errors may add up.

    :return: infinite where a choice differs
    """
    space = plan.stack.action_space
    if not plan.memory:
        found, _ = exported.predict(_handed(given))
        seen = {key: normalized(values, plan.by.get(key)) for key, values in given.items()}
        wanted, _ = plan.policy.predict(_handed(seen), deterministic=True)
    else:
        found, wanted = _episode(plan, exported, given)
    if not isinstance(space, spaces.Box):
        return 0.0 if np.array_equal(found, wanted) else math.inf
    with np.errstate(invalid="ignore"):
        half = 0.5 * (space.high.astype(float) - space.low.astype(float))
    differences = np.abs(np.asarray(found, float) - np.asarray(wanted, float))
    return float((differences / np.where(np.isfinite(half), half, 1.0)).max())


def _handed(parts: Mapping[str, np.ndarray]) -> Any:
    return parts[WHOLE] if WHOLE in parts else dict(parts)


def _episode(
    plan: _Plan, exported: OnnxPolicy, given: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """What the file commands at each step, and what the policy in its wrappers does."""
    n = len(next(iter(given.values())))
    rng = np.random.default_rng(1)
    joints = [None] * n
    if plan.joints is not None:
        joints = rng.standard_normal((n, 2, len(plan.joints.position))).astype(np.float32)
    state, own, held = None, None, [layer.memory for layer in plan.stack.layers]
    found, wanted = [], []
    for k in range(n):
        observed = {key: values[k] for key, values in given.items()}
        action, state = exported.predict(_handed(observed), state, joints=joints[k])  # type: ignore[arg-type]
        found.append(action)
        action, own, held = _stepped(plan, observed, joints[k], own, held)
        wanted.append(action)
    return np.array(found), np.array(wanted)


def _stepped(
    plan: _Plan, observed: Mapping[str, np.ndarray], joints: Any, own: Any, held: list[Any]
) -> tuple[np.ndarray, Any, list[Any]]:
    """One step of the policy in its wrappers, as they compute it: in double precision, by NumPy."""
    start = np.array([own is None])
    seen, below = dict(observed), []
    for layer, memory in reversed(list(zip(plan.stack.layers, held, strict=True))):
        below.insert(0, seen[WHOLE].astype(np.float64))
        if layer.transform.observed:
            seen = {WHOLE: np.concatenate([seen[WHOLE], memory]).astype(np.float32)}
    seen = {key: normalized(values, plan.by.get(key)) for key, values in seen.items()}
    if plan.function is not None and plan.function.joints is not None:
        states = np.zeros((1, 1 + max(*plan.joints.position, *plan.joints.velocity)))  # type: ignore[union-attr]
        for places, values in zip(plan.joints, joints, strict=True):  # type: ignore[arg-type]
            states[:, list(places)] = values
        plan.policy.read_states, before = lambda: states, plan.policy.read_states
        try:
            action, own = plan.policy.predict(_handed(seen), own, start, deterministic=True)
        finally:
            plan.policy.read_states = before
    else:
        action, own = plan.policy.predict(_handed(seen), own, start, deterministic=True)
    after = []
    for layer, obs, memory in zip(plan.stack.layers, below, held, strict=True):
        read = tuple(np.asarray(joints, float)) if layer.joints else ()
        action, remembered = _commanded(layer, np.asarray(action, float), obs, memory, *read)
        space = layer.action_space
        action = np.clip(action.astype(space.dtype), space.low, space.high)
        after.append(remembered)
    return action, own, after
