"""Export a policy to an ONNX file, checked against the policy before it is written."""

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from sb3_hds.core.trajectories.storage import write_bytes
from sb3_hds.deploy.conversion import IR_VERSION, from_jax, from_torch
from sb3_hds.deploy.metadata import metadata_of, prune, write_metadata
from sb3_hds.deploy.observations import (
    SINGLE,
    load_vec_normalize,
    normalizations,
    normalized,
    parts_of,
    random_observations,
)
from sb3_hds.deploy.onnx_policy import OnnxPolicy
from sb3_hds.deploy.plan import (
    Plan,
    Stack,
    apply_layer,
    checked_stack,
    compute,
    function_of,
    ports_of,
    stack_of,
)
from sb3_hds.errors import ExportError

#: number of observations on which a file and its policy are compared
N_CHECKED = 1_000

#: largest difference of actions, relative to half their range, or absolute without limits
TOLERANCE = 1e-5


@dataclasses.dataclass(frozen=True)
class Exported:
    """
    An exported file.

    :param path: of the file
    :param n_bytes: its size
    :param largest_error: of the actions on ``n_checked`` observations, relative to half their range
    :param metadata: as stored in the file
    """

    path: Path
    n_bytes: int
    largest_error: float
    n_checked: int
    metadata: Mapping[str, Any]

    def __str__(self) -> str:
        metadata = self.metadata
        lines = [
            f"{self.path}: {self.n_bytes / 1024:.1f} KiB, opset {metadata['opset']}",
            f"  in:  {', '.join(metadata['inputs'])}",
            f"  out: {', '.join(metadata['outputs'])}",
            f"  {self.n_checked:,} observations: actions differ from predict by at most "
            f"{self.largest_error:.1e} of half their range",
        ]
        if metadata["outside"]:
            lines.append(
                f"  not in the file, needed where it runs: {', '.join(metadata['outside'])}"
            )
        return "\n".join(lines)


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
    Export the deterministic policy, from the observation of the environment to its command: with
    normalisation, network, squashing and scaling, and with the wrappers of :mod:`sb3_hds.wrappers`
    that are functions (:class:`~sb3_hds.wrappers.CPGPrior`, filters), whose memory becomes inputs
    and outputs.

    The file is written only if it agrees with ``predict`` on 1,000 observations.

    :param model: of ours, of SBX or of Stable-Baselines3, or only a policy, as from
        :func:`~sb3_hds.load_policy`
    :param path: of the file; an existing one is replaced
    :param env: the environment of the training, with its wrappers; default: the model's own
    :param layers: whether wrappers go into the file; otherwise they are needed where it runs
    :param normalize: a ``VecNormalize``, or the path of its file, which is unpickled; default: that
        around the model's environment
    :param dt: control interval [s]; default: the environment's own
    :param observations: to compare on, with a leading axis; default: 1,000 random ones
    :return: the exported file
    :raises ExportError: for a policy that cannot be exported, or a file that disagrees with it
    :raises OSError: if the file cannot be written; an older one then remains
    """
    policy = getattr(model, "policy", model)
    function = function_of(policy)
    if isinstance(normalize, str | os.PathLike):
        normalize = load_vec_normalize(normalize)
    if normalize is None and hasattr(model, "get_vec_normalize_env"):
        normalize = model.get_vec_normalize_env()
    env = env if env is not None else _first_env(model)
    stack = Stack((), policy.observation_space, policy.action_space, ())
    if env is not None:
        stack = checked_stack(stack_of(env, layers), env, policy)
    plan = Plan(policy, function, stack, normalizations(normalize))
    ports = ports_of(plan)
    inputs = list(ports.values())
    outputs = ["action", *(f"next_{part.name}" for part in plan.memory)]
    if plan.function is None:
        if stack.layers:
            raise ExportError(
                f"{stack.layers[0].name} around the environment can be exported with JAX policies "
                "only, and this one is of torch: export with layers=False, and wrap the "
                "environment where the file runs."
            )
        proto = from_torch(policy, inputs, outputs, plan.by)
    else:
        inlined = bool(plan.memory) or not hasattr(policy, "policy_function")
        computed = partial(compute, plan, tuple(ports))
        proto = from_jax(computed, inputs, outputs, inlined=inlined)
    proto.ir_version = IR_VERSION
    prune(proto)
    metadata = metadata_of(plan, model, env, dt, ports, outputs)
    write_metadata(proto, metadata)
    given = _observations_to_check(plan, observations)
    error = _largest_error(plan, OnnxPolicy(proto.SerializeToString()), given)
    n = len(next(iter(given.values())))
    if not error <= TOLERANCE:
        raise ExportError(
            f"The file would not compute what the policy does: on {n:,} observations, actions "
            f"differ by {error:.1e} of half their range, and {TOLERANCE:g} is allowed. Nothing was "
            "written. If observations are far larger than their standard deviation, rounding "
            "dominates: pass measured ones to compare on, observations=."
        )
    metadata["checked"] = {"n": n, "largest_error": error}
    write_metadata(proto, metadata)
    content = proto.SerializeToString()
    return Exported(write_bytes(path, content), len(content), error, n, metadata)


def _first_env(model: Any) -> gymnasium.Env | None:
    """The first copy of a model's environment, if it is in this process."""
    vec_env = getattr(model, "env", None)
    envs = getattr(getattr(vec_env, "unwrapped", vec_env), "envs", None)
    return envs[0] if isinstance(envs, Sequence) and len(envs) else None


def _observations_to_check(plan: Plan, observations: Any) -> dict[str, np.ndarray]:
    space = plan.stack.observation_space
    if observations is None:
        scales = {key: (by.mean, by.scale) for key, by in plan.by.items()}
        known = plan.function.scales if plan.function else None
        if known is not None and not scales and isinstance(space, spaces.Box):
            scales = {SINGLE: tuple(np.reshape(part, space.shape) for part in known)}
        if plan.stack.layers:
            scales = {}
        return random_observations(space, N_CHECKED, scales, np.random.default_rng(0))  # type: ignore[arg-type]
    given = observations if isinstance(observations, Mapping) else {SINGLE: observations}
    if given.keys() != parts_of(space).keys():
        raise ExportError(f"observations must have the parts {list(parts_of(space))}.")
    found = {}
    for key, values in given.items():
        values = np.asarray(values)
        found[key] = values.astype(np.float32) if values.dtype.kind == "f" else values
    return found


def _largest_error(plan: Plan, exported: OnnxPolicy, given: Mapping[str, np.ndarray]) -> float:
    """
    Without memory, of all observations at once; otherwise of one episode, so that errors
    accumulate.

    :return: infinite if a discrete choice differs
    """
    space = plan.stack.action_space
    if not plan.memory:
        found, _ = exported.predict(_as_observation(given))
        seen = {key: normalized(values, plan.by.get(key)) for key, values in given.items()}
        wanted, _ = plan.policy.predict(_as_observation(seen), deterministic=True)
    else:
        found, wanted = _episode(plan, exported, given)
    if not isinstance(space, spaces.Box):
        return 0.0 if np.array_equal(found, wanted) else math.inf
    with np.errstate(invalid="ignore"):
        half = 0.5 * (space.high.astype(float) - space.low.astype(float))
    differences = np.abs(np.asarray(found, float) - np.asarray(wanted, float))
    return float((differences / np.where(np.isfinite(half), half, 1.0)).max())


def _as_observation(parts: Mapping[str, np.ndarray]) -> Any:
    return parts[SINGLE] if SINGLE in parts else dict(parts)


def _episode(
    plan: Plan, exported: OnnxPolicy, given: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Commands of the file in one episode, and those of the policy in its wrappers."""
    n = len(next(iter(given.values())))
    rng = np.random.default_rng(1)
    joints = [None] * n
    if plan.joints is not None:
        joints = rng.standard_normal((n, 2, len(plan.joints.position))).astype(np.float32)
    state, own, memories = None, None, [layer.memory for layer in plan.stack.layers]
    found, wanted = [], []
    for k in range(n):
        observed = {key: values[k] for key, values in given.items()}
        action, state = exported.predict(_as_observation(observed), state, joints=joints[k])  # type: ignore[arg-type]
        found.append(action)
        action, own, memories = _wrapped_step(plan, observed, joints[k], own, memories)
        wanted.append(action)
    return np.array(found), np.array(wanted)


def _wrapped_step(
    plan: Plan, observed: Mapping[str, np.ndarray], joints: Any, own: Any, memories: list[Any]
) -> tuple[np.ndarray, Any, list[Any]]:
    """One step of the policy in its wrappers, as they compute: in double precision, by NumPy."""
    start = np.array([own is None])
    seen, below = dict(observed), []
    for layer, memory in reversed(list(zip(plan.stack.layers, memories, strict=True))):
        below.insert(0, seen[SINGLE].astype(np.float64))
        if layer.transform.observed:
            seen = {SINGLE: np.concatenate([seen[SINGLE], memory]).astype(np.float32)}
    seen = {key: normalized(values, plan.by.get(key)) for key, values in seen.items()}
    act = partial(plan.policy.predict, _as_observation(seen), own, start, deterministic=True)
    if plan.function is not None and plan.function.joints is not None:
        states = np.zeros((1, 1 + max(*plan.joints.position, *plan.joints.velocity)))  # type: ignore[union-attr]
        for indices, values in zip(plan.joints, joints, strict=True):  # type: ignore[arg-type]
            states[:, list(indices)] = values
        plan.policy.read_states, before = lambda: states, plan.policy.read_states
        try:
            action, own = act()
        finally:
            plan.policy.read_states = before
    else:
        action, own = act()
    after = []
    for layer, obs, memory in zip(plan.stack.layers, below, memories, strict=True):
        read = tuple(np.asarray(joints, float)) if layer.joints else ()
        action, remembered = apply_layer(layer, np.asarray(action, float), obs, memory, *read)
        space = layer.action_space
        action = np.clip(action.astype(space.dtype), space.low, space.high)
        after.append(remembered)
    return action, own, after
