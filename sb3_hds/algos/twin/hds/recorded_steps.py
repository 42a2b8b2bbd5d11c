"""The real steps that a model has seen, and how they travel with it."""

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


class Source(NamedTuple):
    """
    Where measured steps are.

    :param buffer: SB3's replay buffer; None before there is one
    :param dt: time step of the twin [s]; None while there is no twin
    :param space: of the actions
    :param limit: steps that are saved, the latest; 0: none
    """

    buffer: Any
    dt: float | None
    space: Any
    limit: int


class RecordedSteps:
    """
    The real steps that a model has seen. For SB3, which saves it beside the policy, it is a module
    with ``state_dict`` and ``load_state_dict``.

    :param source: says where they are now
    :param earlier: data from before this model, for example a file of random motion
    """

    def __init__(self, source: Callable[[], Source], earlier: Trajectories | None = None) -> None:
        self._source = source
        self.earlier = None if earlier is None else _counted(earlier)
        self._recordings = Recordings(self._n_earlier)

    def trajectories(self, latest: int | None = None) -> Trajectories | None:
        """
        :param latest: number of steps, the latest; None: all
        :return: everything measured, oldest first; None before anything was
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
        :return: everything measured, oldest first; ``origin`` numbers the recordings from the first
            there ever was. Those whose beginning is lost are left out where there are others.
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
        """What is in the replay buffer, in the order in which it began."""
        buffer, dt, space, _ = self._source()
        if buffer is None or buffer.size() == 0 or dt is None:
            return None
        try:
            obs, actions, begins = episodes_in(buffer, space, only_finite=True)
        except TrajectoryError:  # none of the steps is finite
            return None
        numbers = np.array(self._recordings.numbers(buffer, begins))
        if (numbers < 0).all():  # one that has no end is older than the buffer
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
            self._numbered()  # some may not have been looked at yet
            numbers = self._recordings.state_dict(buffer, len(order))
            saved |= {f"recordings.{name}": tensor for name, tensor in numbers.items()}
            limit -= len(order) * buffer.n_envs
        if self.earlier is not None and limit > 0:
            earlier = _tensors_of(_whole(self.earlier, limit))
            saved |= {f"earlier.{name}": tensor for name, tensor in earlier.items()}
        return saved

    def load_state_dict(self, tensors: dict[str, th.Tensor], strict: bool = True) -> None:
        """
        Fill the replay buffer with what was saved.

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
    :param argument: for which it is given
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
    """The end of the data; the recording in which it begins is cut."""
    obs, actions, left = [], [], max(n_steps, 1)
    for i in reversed(range(len(data))):
        seen, taken = data.episode(i)
        obs.insert(0, seen[-left - 1 :])
        actions.insert(0, taken[-left:])
        left -= len(actions[0])
        if left <= 0:
            break
    first = len(data) - len(obs)
    cut = Trajectories.from_arrays(obs, actions, dt=data.dt, conditions=data.conditions[first:])
    return dataclasses.replace(cut, origin=data.origin[first:])


def _whole(data: Trajectories, n_steps: int) -> Trajectories:
    """The latest whole recordings that together have at most ``n_steps`` steps."""
    after = np.cumsum(data.lengths[::-1])[::-1]
    fit = np.flatnonzero(after <= n_steps)
    return data[fit] if len(fit) else last_steps(data, n_steps)


def _counted(data: Trajectories) -> Trajectories:
    """With recordings numbered 0, 1, ..."""
    return dataclasses.replace(data, origin=np.unique(data.origin, return_inverse=True)[1])


def _part(tensors: dict[str, th.Tensor], name: str) -> dict[str, th.Tensor]:
    return {
        key.partition(".")[2]: tensor
        for key, tensor in tensors.items()
        if key.startswith(f"{name}.")
    }


def _for_copies(columns: dict[str, np.ndarray], n_envs: int) -> dict[str, np.ndarray]:
    """One copy after the other, shared out among another number of copies."""
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
    Counts the recordings that went through a replay buffer.

    Whether a window is held out depends on the number of its recording. Counted from the oldest
    step that is left, recordings would get other numbers whenever old steps are overwritten, or
    left out of a file, and what was learned from would be held out.

    :param n_before: recordings that there were before any went through the buffer
    """

    def __init__(self, n_before: int = 0) -> None:
        self._n_before = n_before
        #: of each recording, at which step of all environments together it began
        self.starts: list[int] = []
        #: steps of each environment that had gone through the buffer when it was last looked at,
        #: and where it stood
        self._n_steps, self._position = 0, 0

    def n_steps(self, buffer: Any) -> int:
        """:return: steps of each environment that went through the buffer, those lost included"""
        since = (buffer.pos - self._position) % buffer.buffer_size
        return max(self._n_steps + since, buffer.size())

    @property
    def latest(self) -> int:
        """The number that was given last."""
        return max(0, self._n_before + len(self.starts) - 1)

    def numbers(self, buffer: Any, begins: Sequence[tuple[int, int]]) -> list[int]:
        """
        To be called at least once each time that the buffer is filled.

        :param begins: of each recording, steps since the oldest one in the buffer, and environment
        :return: its number; -1 for the rest of one whose beginning is lost
        """
        self._n_steps, self._position = self.n_steps(buffer), buffer.pos
        first = self._n_steps - buffer.size()
        starts = [(first + row) * buffer.n_envs + env for row, env in begins]
        # In each environment the first one that is left may have begun earlier.
        oldest = {env: min(row for row, e in begins if e == env) for _, env in begins}
        cut = [first > 0 and row == oldest[env] for row, env in begins]
        known = set(self.starts)
        whole = {s for s, rest in zip(starts, cut, strict=True) if not rest and s not in known}
        self.starts += sorted(whole)
        number = {start: self._n_before + i for i, start in enumerate(self.starts)}
        return [number.get(start, -1) for start in starts]

    def state_dict(self, buffer: Any, n_kept: int) -> dict[str, th.Tensor]:
        """:param n_kept: steps of each environment that are saved, the latest"""
        lost = self.n_steps(buffer) - n_kept
        numbers = {"starts": self.starts, "lost": lost, "before": self._n_before}
        return {name: th.as_tensor(value, dtype=th.int64) for name, value in numbers.items()}

    def load_state_dict(self, saved: dict[str, th.Tensor], buffer: Any, n_saved: int) -> None:
        """
        :param buffer: filled with what was saved, or the latest of it
        :param n_saved: steps of each environment that were saved
        """
        self.starts, self._n_before = saved["starts"].tolist(), int(saved["before"])
        self._n_steps, self._position = int(saved["lost"]) + n_saved, buffer.pos
