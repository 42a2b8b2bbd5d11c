"""A policy from an ONNX file, run by onnxruntime alone."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sb3_hds.errors import ExportError

#: key of the JSON text among the metadata of the file
METADATA = "sb3_hds.policy"
VERSION = 1

_DTYPES = {
    "tensor(float)": np.float32,
    "tensor(double)": np.float64,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
}

State = tuple[np.ndarray, ...]


class OnnxPolicy:
    """
    Acts like the exported policy with ``deterministic=True``. ``predict`` has the signature of SB3,
    so that ``evaluate_policy`` accepts it as a model.

    Imports neither jax nor torch.

    :param source: path or content of a file of :func:`~sb3_hds.deploy.export_onnx`
    :param threads: of onnxruntime; one is fastest for small networks
    :raises FileNotFoundError: if there is no such file
    :raises ExportError: for a file without our metadata, a damaged one, or one of a newer version
    :raises ImportError: without onnxruntime
    """

    def __init__(self, source: str | os.PathLike[str] | bytes, threads: int = 1) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise ImportError(
                "Running a policy needs onnxruntime: pip install onnxruntime."
            ) from error
        name = "The file" if isinstance(source, bytes) else f"'{source}'"
        content = source if isinstance(source, bytes) else Path(source).read_bytes()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"]
            )
        # onnxruntime's errors have no common base class.
        except Exception as error:
            raise ExportError(f"{name} is no ONNX file that onnxruntime reads: {error}.") from error
        text = self._session.get_modelmeta().custom_metadata_map.get(METADATA)
        #: names, units, bounds and versions, as stored in the file
        self.metadata: Mapping[str, Any] = _metadata(text, name)
        self._dtypes = {port.name: _DTYPES[port.type] for port in self._session.get_inputs()}
        self._shapes = {port.name: port.shape[1:] for port in self._session.get_inputs()}
        self._memory = self.metadata["memory"]
        observed = self.metadata["observations"]
        self._keys = {name: name.partition(".")[2] for name in self._dtypes if name in observed}
        self._outputs = ["action", *(part["output"] for part in self._memory)]
        self._discrete = self.metadata["actions"][0].get("n") is not None

    @property
    def dt(self) -> float | None:
        """Control interval of the policy [s]; None if it is not known."""
        return self.metadata["dt"]

    @property
    def observation_names(self) -> list[str]:
        """Names of the entries of an observation, in the order of the inputs."""
        return [c["name"] for channels in self.metadata["observations"].values() for c in channels]

    @property
    def action_names(self) -> list[str]:
        """Names of the entries of an action."""
        return [actuator["name"] for actuator in self.metadata["actions"]]

    @property
    def joints(self) -> tuple[list[int], list[int]] | None:
        """
        Indices, in ``qpos`` followed by ``qvel``, of the positions and velocities that the policy
        reads in addition to the observation; None if it reads none.
        """
        found = self.metadata["joints"]
        return None if found is None else (found["position"], found["velocity"])

    def predict(
        self,
        observation: Any,
        state: State | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
        *,
        joints: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> tuple[np.ndarray, State | None]:
        """
        :param observation: one, or a batch; a dictionary if the policy was trained with one
        :param state: returned by the last call; None: all episodes start now
        :param episode_start: which episodes start now
        :param deterministic: ignored, for compatibility with SB3
        :param joints: positions and velocities, if the policy reads them
        :return: actions within their bounds, one per observation; the state for the next call, None
            if the policy has no memory
        :raises ValueError: for an observation of another shape, or one that is not finite
        """
        rows, several = self._rows(observation, joints)
        n = len(next(iter(rows.values())))
        for i, part in enumerate(self._memory):
            initial = np.broadcast_to(np.asarray(part["initial"]), (n, len(part["initial"])))
            memory = initial if state is None else state[i]
            if episode_start is not None:
                memory = np.where(np.reshape(episode_start, (-1, 1)), initial, memory)
            rows[part["input"]] = memory.astype(self._dtypes[part["input"]])
        action, *memory = map(np.asarray, self._session.run(self._outputs, rows))
        if self._discrete:
            action = action.astype(np.int64)
        return (action if several else action[0]), (tuple(memory) if self._memory else None)

    def _rows(self, observation: Any, joints: Any) -> tuple[dict[str, np.ndarray], bool]:
        rows, several = {}, False
        for name, key in self._keys.items():
            try:
                values = np.asarray(observation[key] if key else observation)
            except (KeyError, IndexError, TypeError) as error:
                wanted = ", ".join(self._keys.values())
                raise ValueError(
                    f"The policy takes a dictionary of {wanted}, got {type(observation).__name__}."
                ) from error
            rows[name], several = self._batch(name, values)
        if (joints is None) != (self.joints is None):
            raise ValueError(
                "The policy reads no joints: leave out joints."
                if self.joints is None
                else "The policy reads joints in addition to the observation: pass "
                "joints=(positions, velocities)."
            )
        if joints is not None:
            for name, values in zip(("joint_position", "joint_velocity"), joints, strict=True):
                rows[name], _ = self._batch(name, np.asarray(values))
        return rows, several

    def _batch(self, name: str, values: np.ndarray) -> tuple[np.ndarray, bool]:
        shape = tuple(self._shapes[name])
        several = values.ndim > len(shape)
        if values.shape[int(several) :] != shape or values.ndim > len(shape) + 1:
            raise ValueError(
                f"{name} must have the shape {shape}, or that with a leading batch axis, got "
                f"{values.shape}."
            )
        if not np.isfinite(values).all():
            raise ValueError(
                f"{name} is not finite: {values}. There is no action for it: repeat the last one, "
                "or stop the robot safely."
            )
        return (values if several else values[None]).astype(self._dtypes[name]), several


def _metadata(text: str | None, name: str) -> dict[str, Any]:
    if text is None:
        raise ExportError(
            f"{name} is an ONNX file without {METADATA!r} in its metadata: sb3-hds export, or "
            "model.export_onnx, writes those that have it."
        )
    try:
        found = json.loads(text)
        version = int(found["version"])
    except (ValueError, KeyError, TypeError) as error:
        raise ExportError(f"{name} has damaged metadata ({error}): export it again.") from error
    if version > VERSION:
        raise ExportError(
            f"{name} is of version {version}, this sb3_hds reads up to {VERSION}. Upgrade sb3_hds."
        )
    return found
