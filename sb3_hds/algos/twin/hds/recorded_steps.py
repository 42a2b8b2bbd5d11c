"""The real steps that a model has recorded, and how they are saved with it."""

import dataclasses
import json
import os
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_hds.core import Trajectories
from sb3_hds.core.trajectories.replay_buffer import episodes_in
from sb3_hds.errors import TrajectoryError

_COLUMNS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class MeasuredSteps(NamedTuple):
    """
    The replay buffer with the measured steps.

    :param buffer: SB3's replay buffer; None before there is one
    :param dt: time step of the twin [s]; None without a twin
    :param space: action space
    :param limit: number of latest steps to save; 0: none
    """

    buffer: Any
    dt: float | None
    space: Any
    limit: int


class RecordedSteps:
    """
    The real steps that a model has recorded. SB3 saves them beside the policy, as a module with
    ``state_dict`` and ``load_state_dict``.

    :param source: returns the current source of steps
    :param earlier: data from before this model, for example a file of random motion
    """

    def __init__(
        self, source: Callable[[], MeasuredSteps], earlier: Trajectories | None = None
    ) -> None:
        self._source = source
        self.earlier = None if earlier is None else _counted(earlier)
        self._recordings = Recordings(self._n_earlier)

    def trajectories(self, latest: int | None = None) -> Trajectories | None:
        """
        :param latest: number of latest steps to return; None: all
        :return: all measured data, oldest first; None without any
        """
        buffer, dt, space, _ = self._source()
        parts = [] if self.earlier is None else [self.earlier]
        if buffer is not None and buffer.size() > 0 and dt is not None:
            try:
                found = Trajectories.from_replay_buffer(buffer, dt, space, only_finite=True)
                parts.append(found)
            except TrajectoryError:  # none of the steps is finite
                pass
        data = Trajectories.concatenate(parts) if parts else None
        return data if data is None or latest is None else last_steps(data, latest)

    def recordings(self) -> Trajectories | None:
        """
        :return: all measured data, oldest first; ``origin`` numbers the recordings since the first
            one ever. Recordings whose start was overwritten are left out if there are others.
        """
        parts = [self.earlier] if self.earlier is not None else []
        found = self._numbered()
        if found is not None:
            parts.append(found)
        if not parts:
            return None
        origin = np.concatenate([part.origin for part in parts])
        return dataclasses.replace(Trajectories.concatenate(parts), origin=origin)

    @property
    def _n_earlier(self) -> int:
        return 0 if self.earlier is None else int(self.earlier.origin.max()) + 1

    def _numbered(self) -> Trajectories | None:
        """:return: the recordings in the replay buffer, sorted by their start"""
        buffer, dt, space, _ = self._source()
        if buffer is None or buffer.size() == 0 or dt is None:
            return None
        try:
            obs, actions, begins = episodes_in(buffer, space, only_finite=True)
        except TrajectoryError:  # none of the steps is finite
            return None
        numbers = np.array(self._recordings.numbers(buffer, begins))
        if (numbers < 0).all():  # a single recording is longer than the buffer
            numbers[:] = self._recordings.latest
        found = Trajectories.from_arrays(obs, actions, dt=dt, conditions="replay buffer")
        found = dataclasses.replace(found, origin=numbers)
        order = np.array(sorted(range(len(begins)), key=begins.__getitem__))
        return found[order[numbers[order] >= 0]]

    def state_dict(self) -> dict[str, th.Tensor]:
        """:return: the latest steps, oldest first, shape ``(steps, n_envs, ...)``; earlier data"""
        buffer, _, _, limit = self._source()
        saved: dict[str, th.Tensor] = {}
        if buffer is not None and limit and buffer.size() > 0:
            order = np.arange(buffer.pos)
            if buffer.full:
                order = (buffer.pos + np.arange(buffer.buffer_size)) % buffer.buffer_size
            order = order[-max(1, limit // buffer.n_envs) :]
            for name in _COLUMNS:
                if hasattr(buffer, name):
                    saved[name] = th.as_tensor(getattr(buffer, name)[order].copy())
            self._numbered()  # gives new recordings their numbers
            numbers = self._recordings.state_dict(buffer, len(order))
            saved |= {f"recordings.{name}": tensor for name, tensor in numbers.items()}
            limit -= len(order) * buffer.n_envs
        if self.earlier is not None and limit > 0:
            earlier = _tensors_of(_latest_recordings(self.earlier, limit))
            saved |= {f"earlier.{name}": tensor for name, tensor in earlier.items()}
        return saved

    def load_state_dict(self, tensors: dict[str, th.Tensor], strict: bool = True) -> None:
        """
        Fill the replay buffer with the saved steps.

        :raises RuntimeError: if the data do not fit the spaces
        """
        if "earlier.obs" in tensors:
            self.earlier = _unpadded(_part(tensors, "earlier"))
        buffer = self._source().buffer
        if buffer is None or "observations" not in tensors:
            return
        columns = {name: tensors[name].cpu().numpy() for name in _COLUMNS if name in tensors}
        as_saved = columns["observations"].shape[1] == buffer.n_envs
        columns = _for_copies(columns, buffer.n_envs)
        n_saved = len(columns["observations"])
        n = min(n_saved, buffer.buffer_size)
        for name, values in columns.items():
            kept = getattr(buffer, name, None)
            if kept is None:
                continue
            if kept.shape[1:] != values.shape[1:]:
                raise RuntimeError(
                    f"The saved data have {name} of shape {values.shape[1:]}, this environment "
                    f"has {kept.shape[1:]}."
                )
            kept[:n] = values[-n:]
        buffer.pos, buffer.full = n % buffer.buffer_size, n == buffer.buffer_size
        self._recordings = Recordings(self._n_earlier)
        if as_saved and "recordings.starts" in tensors:
            self._recordings.load_state_dict(_part(tensors, "recordings"), buffer, n_saved)


def data_from(source: Any, argument: str = "pretrain_data") -> Trajectories | None:
    """
    :param source: trajectories, the path of a file that ``Trajectories.save`` wrote, or None
    :param argument: name of the argument, for the message
    :return: the trajectories, or None
    :raises TrajectoryError: for anything else, or a file that cannot be read
    """
    if source is None or isinstance(source, Trajectories):
        return source
    if isinstance(source, str | os.PathLike):
        return Trajectories.load(source)
    raise TrajectoryError(
        f"{argument} takes Trajectories or the path of a file, got {source!r}. "
        "Use Trajectories.from_arrays."
    )


def last_steps(data: Trajectories, n_steps: int) -> Trajectories:
    """:return: the last ``n_steps`` steps of the data; the first recording may be cut"""
    obs, actions, remaining = [], [], max(n_steps, 1)
    for i in reversed(range(len(data))):
        observed, taken = data.episode(i)
        obs.insert(0, observed[-remaining - 1 :])
        actions.insert(0, taken[-remaining:])
        remaining -= len(actions[0])
        if remaining <= 0:
            break
    first = len(data) - len(obs)
    cut = Trajectories.from_arrays(obs, actions, dt=data.dt, conditions=data.conditions[first:])
    return dataclasses.replace(cut, origin=data.origin[first:])


def _latest_recordings(data: Trajectories, n_steps: int) -> Trajectories:
    """:return: the latest complete recordings with at most ``n_steps`` steps in total"""
    after = np.cumsum(data.lengths[::-1])[::-1]
    fit = np.flatnonzero(after <= n_steps)
    return data[fit] if len(fit) else last_steps(data, n_steps)


def _counted(data: Trajectories) -> Trajectories:
    """:return: the data with recordings numbered 0, 1, ..."""
    return dataclasses.replace(data, origin=np.unique(data.origin, return_inverse=True)[1])


def _part(tensors: dict[str, th.Tensor], name: str) -> dict[str, th.Tensor]:
    return {
        key.partition(".")[2]: tensor
        for key, tensor in tensors.items()
        if key.startswith(f"{name}.")
    }


def _for_copies(columns: dict[str, np.ndarray], n_envs: int) -> dict[str, np.ndarray]:
    """:return: the columns of all environments in sequence, divided among ``n_envs``"""
    n_saved = columns["observations"].shape[1]
    if n_saved == n_envs:
        return columns
    n = len(columns["observations"]) * n_saved // n_envs
    if not n:
        warnings.warn(f"The saved data are fewer than {n_envs} steps and were left out.")
    line = {k: v.swapaxes(0, 1).reshape(-1, *v.shape[2:]) for k, v in columns.items()}
    return {
        k: v[: n * n_envs].reshape(n_envs, n, *v.shape[1:]).swapaxes(0, 1) for k, v in line.items()
    }


def _tensors_of(data: Trajectories) -> dict[str, th.Tensor]:
    names = ("obs", "actions", "lengths", "origin")
    saved = {name: th.as_tensor(np.array(getattr(data, name))) for name in names}
    labels = np.frombuffer(json.dumps(data.conditions).encode(), np.uint8).copy()
    dt = th.as_tensor(data.dt, dtype=th.float64)
    return saved | {"dt": dt, "conditions": th.as_tensor(labels)}


def _unpadded(saved: dict[str, th.Tensor]) -> Trajectories:
    obs, actions = (saved[name].cpu().numpy() for name in ("obs", "actions"))
    lengths = saved["lengths"].cpu().numpy()
    labels = json.loads(saved["conditions"].cpu().numpy().tobytes())
    origin = saved["origin"].cpu().numpy()
    found = Trajectories.from_arrays(
        [x[: n + 1] for x, n in zip(obs, lengths, strict=True)],
        [u[:n] for u, n in zip(actions, lengths, strict=True)],
        dt=float(saved["dt"]),
        conditions=labels,
    )
    return dataclasses.replace(found, origin=origin)


class Recordings:
    """
    Numbers of the recordings that were added to a replay buffer.

    Whether a window is held out depends on the number of its recording. Numbers that start at the
    oldest step in the buffer would change when old steps are overwritten or not saved, and windows
    that were learned from would be held out.

    :param n_before: number of recordings before the first one in the buffer
    """

    def __init__(self, n_before: int = 0) -> None:
        self._n_before = n_before
        #: start of each recording, counted in steps of all environments together
        self.starts: list[int] = []
        #: steps of each environment that had been added at the last call of `numbers`, and the
        #: position of the buffer then
        self._n_steps, self._position = 0, 0

    def n_steps(self, buffer: Any) -> int:
        """:return: steps of each environment that were added so far, overwritten ones included"""
        # -1: the last step was counted before it was stored, and never was.
        since = (buffer.pos + 1 - self._position) % buffer.buffer_size - 1
        return max(self._n_steps + since, buffer.size())

    @property
    def latest(self) -> int:
        """Number of the latest recording."""
        return max(0, self._n_before + len(self.starts) - 1)

    def numbers(self, buffer: Any, begins: Sequence[tuple[int, int]]) -> list[int]:
        """
        To be called at least once each time that the buffer is filled.

        :param begins: start of each recording, in steps after the oldest one in the buffer, and its
            environment
        :return: number of each recording; -1: its start was overwritten
        """
        self._n_steps, self._position = self.n_steps(buffer), buffer.pos
        first = self._n_steps - buffer.size()
        starts = [(first + row) * buffer.n_envs + env for row, env in begins]
        # The oldest recording of each environment may have started before the oldest step.
        oldest = {env: min(row for row, e in begins if e == env) for _, env in begins}
        cut = [first > 0 and row == oldest[env] for row, env in begins]
        known = set(self.starts)
        new = {s for s, is_cut in zip(starts, cut, strict=True) if not is_cut and s not in known}
        self.starts += sorted(new)
        number = {start: self._n_before + i for i, start in enumerate(self.starts)}
        return [number.get(start, -1) for start in starts]

    def state_dict(self, buffer: Any, n_kept: int) -> dict[str, th.Tensor]:
        """:param n_kept: number of latest steps of each environment that are saved"""
        lost = self.n_steps(buffer) - n_kept
        numbers = {"starts": self.starts, "lost": lost, "before": self._n_before}
        return {name: th.as_tensor(value, dtype=th.int64) for name, value in numbers.items()}

    def load_state_dict(self, saved: dict[str, th.Tensor], buffer: Any, n_saved: int) -> None:
        """
        :param buffer: filled with the saved steps, or the latest of them
        :param n_saved: number of saved steps of each environment
        """
        self.starts, self._n_before = saved["starts"].tolist(), int(saved["before"])
        self._n_steps, self._position = int(saved["lost"]) + n_saved, buffer.pos
