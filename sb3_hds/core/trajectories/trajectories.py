"""Measured data."""

import dataclasses
import glob
import math
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Bool, Float64, Int

from sb3_hds.core.trajectories.episodes import (
    check_conditions,
    check_dt,
    check_episodes,
    pad,
    resample,
    same_interval,
)
from sb3_hds.core.trajectories.replay_buffer import episodes_in
from sb3_hds.core.trajectories.storage import log_reader, read_npz, write_npz
from sb3_hds.errors import TrajectoryError

_FORMAT, _VERSION = "sb3_hds.Trajectories", 1
_LEAVES = ("obs", "actions", "mask", "origin")


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Trajectories:
    """
    Episodes of observations and actions, sampled at one interval and padded to one length.

    **Action k acts from observation k to observation k + 1.** Make them by :meth:`from_arrays`,
    :meth:`from_replay_buffer` or :meth:`load`. They are double precision NumPy arrays, and a JAX
    pytree whose leaves are the arrays; ``dt`` and ``conditions`` are static.

    :param obs: shape ``(n, T + 1, n_obs)``; padded with the last row of the episode
    :param actions: shape ``(n, T, n_act)``; padded with zeros
    :param mask: False for padding: of step k and of ``obs[:, k + 1]``; shape ``(n, T)``
    :param dt: sampling interval [s]
    :param conditions: a label of each trajectory's conditions, such as a load or a gain
    :param origin: index of the recording that each trajectory is part of, shape ``(n,)``; windows
        of one recording share it, because their errors are correlated (one cluster)
    :param report: what reading logs changed, a ``data.Reading``; kept by selections and windows,
        but neither saved nor passed through transformations of JAX
    :raises TrajectoryError: if these do not fit together
    """

    obs: Float64[np.ndarray, "n rows n_obs"]
    actions: Float64[np.ndarray, "n steps n_act"]
    mask: Bool[np.ndarray, "n steps"]
    dt: float
    conditions: tuple[str, ...]
    origin: Int[np.ndarray, " n"]
    report: Any = None

    def __post_init__(self) -> None:
        n, steps = self.mask.shape
        fits = self.obs.shape[:2] == (n, steps + 1) and self.actions.shape[:2] == (n, steps)
        first_steps = np.arange(steps) < self.lengths[:, None]
        if not (n and fits and len(self.conditions) == len(self.origin) == n):
            raise TrajectoryError(
                f"obs {self.obs.shape}, actions {self.actions.shape}, mask {self.mask.shape}, "
                f"{len(self.conditions)} conditions and {len(self.origin)} origins do not fit. "
                "Use Trajectories.from_arrays."
            )
        if not (np.array_equal(self.mask, first_steps) and self.mask[:, 0].all()):
            raise TrajectoryError(
                "mask must be True for the first steps of each trajectory, at least one, "
                "and False for the others. Use Trajectories.from_arrays."
            )

    @classmethod
    def from_arrays(
        cls,
        obs: Iterable[Any],
        actions: Iterable[Any],
        *,
        dt: float,
        conditions: str | Iterable[Any] | None = None,
    ) -> "Trajectories":
        """
        :param obs: one array of shape ``(T + 1, n_obs)`` per trajectory, or one with a leading axis
        :param actions: one array of shape ``(T, n_act)`` per trajectory, or one with a leading axis
        :param dt: sampling interval [s]
        :param conditions: one label per trajectory, or one for all
        :raises TrajectoryError: for a wrong shape, number, interval, or a value that is not finite
        """
        episodes = check_episodes(obs, actions)
        padded_obs, padded_actions, mask = pad(*episodes)
        labels = check_conditions(conditions, len(mask))
        return cls(padded_obs, padded_actions, mask, check_dt(dt), labels, np.arange(len(mask)))

    @classmethod
    def from_replay_buffer(
        cls,
        replay_buffer: Any,
        dt: float,
        action_space: Any = None,
        *,
        scaled: bool = True,
        only_finite: bool = False,
        condition: str = "replay buffer",
    ) -> "Trajectories":
        """
        All episodes in a replay buffer of Stable-Baselines3, finished or not, oldest first.

        Observations are those of the environment: SB3 stores them before ``VecNormalize``.

        :param replay_buffer: SB3's ``ReplayBuffer``, of any number of environments
        :param dt: control interval of the environment [s]
        :param action_space: the box that actions are scaled back to; default: the buffer's own
        :param scaled: whether stored actions are scaled to [-1, 1], as SB3's algorithms store them
        :param only_finite: drop steps with a value that is not finite, and split the episode there
        :param condition: label of all episodes
        :raises TrajectoryError: for spaces other than boxes of one axis, and for an empty buffer
        """
        obs, actions, _ = episodes_in(replay_buffer, action_space, scaled, only_finite)
        return cls.from_arrays(obs, actions, dt=dt, conditions=condition)

    @classmethod
    def concatenate(cls, parts: Iterable["Trajectories"]) -> "Trajectories":
        """
        :param parts: with the same channels, and the same interval to 0.1 %: that of the first
        :raises TrajectoryError: for different intervals or channels, or without parts
        """
        parts = list(parts)
        for part in parts:
            if not same_interval(part.dt, parts[0].dt):
                raise TrajectoryError(
                    f"Only trajectories of equal dt can be joined, got {parts[0].dt} s and "
                    f"{part.dt} s. Resample first: part.resample(dt={parts[0].dt})."
                )
        episodes = [part.episode(i) for part in parts for i in range(len(part))]
        dt = parts[0].dt if parts else 1.0
        labels = [label for part in parts for label in part.conditions]
        joined = cls.from_arrays(*_unzip(episodes), dt=dt, conditions=labels)
        firsts = np.cumsum([0, *(part.origin.max() + 1 for part in parts[:-1])])
        origin = [part.origin + first for part, first in zip(parts, firsts, strict=True)]
        return dataclasses.replace(joined, origin=np.concatenate(origin))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """
        Write one ``.npz`` file, without pickle; a file of that name is replaced.

        :param path: ``.npz`` is appended if missing
        :return: the path of the file
        :raises TrajectoryError: if the file cannot be written
        """
        arrays = {"obs": self.obs, "actions": self.actions, "lengths": self.lengths}
        labels = {"dt": np.array(self.dt), "conditions": np.array(self.conditions, str)}
        marks = {"format": np.array(_FORMAT), "version": np.array(_VERSION)}
        return write_npz(path, arrays | labels | marks | {"origin": self.origin})

    @classmethod
    def load(
        cls,
        files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
        columns: Any = None,
    ) -> "Trajectories":
        """
        Read files of :meth:`save`, recordings and logs.

        Row k of a log is observation k, with the action that acts from then on. Uneven time stamps
        are resampled; a warning and ``report`` say what that changed.

        :param files: path, or pattern with ``*``, or several: ``.npz``, ``.jsonl`` (a recording),
            ``.csv``, ``.parquet``, ``.mat``, ``.h5``, ``.json``, a ROS bag; or ``minari:`` and the
            name of a data set
        :param columns: the meaning of the columns of a log, as a dict or the path of a yml file;
            not needed for files of :meth:`save` or of a recorder
        :raises TrajectoryError: if a file is missing, damaged or of another kind, if a column is
            missing or holds no finite numbers, or if time decreases
        """
        reader = log_reader()
        if columns is None and isinstance(files, str | os.PathLike):
            path = Path(files)
            if reader is None or _is_npz(path):
                return cls._load_npz(path)
        if reader is None:
            raise TrajectoryError(
                "Logs are read by sb3_hds.data, which is not imported. Import it, or use "
                "'from sb3_hds import Trajectories'."
            )
        return reader(files, columns)

    @classmethod
    def _load_npz(cls, path: str | os.PathLike[str]) -> "Trajectories":
        """One file that :meth:`save` wrote."""
        stored = read_npz(path)
        if stored.get("format", np.array("")).tolist() != _FORMAT:
            raise TrajectoryError(
                f"'{path}' was not written by Trajectories.save; it holds: {', '.join(stored)}. "
                "Say what that is, columns={'time': NAME, 'obs': [NAME, ...], 'actions': [NAME, "
                "...]}, or build the data with Trajectories.from_arrays."
            )
        if stored.get("version", np.array(0)) > _VERSION:
            raise TrajectoryError(
                f"'{path}' is of version {stored['version']}, this sb3_hds reads up to "
                f"{_VERSION}. Upgrade sb3_hds."
            )
        try:
            lengths = stored["lengths"].tolist()
            obs = [x[: n + 1] for x, n in zip(stored["obs"], lengths, strict=True)]
            actions = [u[:n] for u, n in zip(stored["actions"], lengths, strict=True)]
            labels = stored["conditions"].tolist()
            loaded = cls.from_arrays(obs, actions, dt=stored["dt"].item(), conditions=labels)
            if loaded.lengths.tolist() != lengths:
                raise ValueError(f"lengths {lengths} of arrays of {loaded.lengths.tolist()} steps")
            return dataclasses.replace(loaded, origin=stored["origin"])
        except (KeyError, ValueError, TypeError) as error:
            raise TrajectoryError(
                f"The content of '{path}' does not fit together ({str(error)[:200]}). "
                "Restore it from a copy, or record it again."
            ) from error

    def __len__(self) -> int:
        return len(self.mask)

    def __getitem__(self, index: Any) -> "Trajectories":
        """:param index: integer, slice, mask or array of integers"""
        chosen = np.atleast_1d(np.arange(len(self))[index])
        if not len(chosen):
            raise TrajectoryError(f"The index {index!r} selects none of {len(self)} trajectories.")
        longest = int(self.lengths[chosen].max())
        return dataclasses.replace(
            self,
            obs=self.obs[chosen, : longest + 1],
            actions=self.actions[chosen, :longest],
            mask=self.mask[chosen, :longest],
            conditions=tuple(self.conditions[i] for i in chosen),
            origin=self.origin[chosen],
        )

    @property
    def lengths(self) -> Int[np.ndarray, " n"]:
        """Number of steps of each trajectory."""
        return self.mask.sum(axis=1)

    @property
    def n_steps(self) -> int:
        """Total number of steps."""
        return int(self.mask.sum())

    @property
    def n_obs(self) -> int:
        """Number of observation channels."""
        return self.obs.shape[2]

    @property
    def n_act(self) -> int:
        """Number of action channels."""
        return self.actions.shape[2]

    def episode(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """:return: observations ``(T + 1, n_obs)`` and actions ``(T, n_act)``, without padding"""
        n = int(self.lengths[i])
        return self.obs[i, : n + 1], self.actions[i, :n]

    def windows(self, length: int, stride: int | None = None) -> "Trajectories":
        """
        Cut into windows of equal length, without padding.

        :param length: steps per window
        :param stride: steps from one window to the next; default: ``length``, without overlap
        :return: the windows in order of trajectory and time, with the ``origin`` of their
            trajectory
        :raises TrajectoryError: if no trajectory is long enough
        """
        stride = length if stride is None else stride
        if length < 1 or stride < 1:
            raise TrajectoryError(
                f"length and stride must be at least 1 step, got {length} and {stride}."
            )
        cuts = [
            (i, k) for i, n in enumerate(self.lengths) for k in range(0, n - length + 1, stride)
        ]
        if not cuts:
            raise TrajectoryError(
                f"No trajectory has {length} steps; the longest has {self.lengths.max()}. "
                "Choose shorter windows."
            )
        source, start = np.array(cuts).T
        steps = start[:, None] + np.arange(length + 1)
        return dataclasses.replace(
            self,
            obs=self.obs[source[:, None], steps],
            actions=self.actions[source[:, None], steps[:, :-1]],
            mask=np.ones((len(cuts), length), bool),
            conditions=tuple(self.conditions[i] for i in source),
            origin=self.origin[source],
        )

    def split(
        self,
        fraction: float = 0.8,
        by: Literal["trajectory", "condition"] = "trajectory",
        seed: int = 0,
    ) -> tuple["Trajectories", "Trajectories"]:
        """
        Split at random into two parts that share no recording, or no condition.

        :param fraction: share of the recordings or conditions in the first part; each part gets at
            least one
        :param by: ``"trajectory"`` keeps windows of one recording together; ``"condition"`` keeps
            trajectories with one label together
        :param seed: of the draw
        :raises TrajectoryError: for fewer than two recordings or conditions
        """
        if by not in ("trajectory", "condition") or not 0.0 < fraction < 1.0:
            raise TrajectoryError(
                "split takes a fraction between 0 and 1 and by='trajectory' or by='condition', "
                f"got fraction={fraction} and by={by!r}."
            )
        labels = self.origin if by == "trajectory" else np.array(self.conditions)
        groups = np.unique(labels)
        if len(groups) < 2:
            raise TrajectoryError(
                f"A split by {by} needs at least two of them, got {len(groups)} among "
                f"{len(self)} trajectories. Record more, or split the recording yourself."
            )
        n_first = min(max(round(fraction * len(groups)), 1), len(groups) - 1)
        drawn = np.random.default_rng(seed).permutation(groups)[:n_first]
        first = np.isin(labels, drawn)
        return self[first], self[~first]

    def resample(self, dt: float, angles: Sequence[int] = ()) -> "Trajectories":
        """
        Change the sampling interval: actions are held, observations interpolated linearly.

        A longer interval keeps only the first of the actions within it, which is exact if they are
        equal. A remainder shorter than one new interval is dropped.

        :param dt: new sampling interval [s]
        :param angles: columns of ``obs`` with angles wrapped to [-pi, pi), which are interpolated
            along the shorter way; otherwise a jump by a full turn would be interpolated, too
        :raises TrajectoryError: if a trajectory is shorter than ``dt``
        """
        ratio = check_dt(dt) / self.dt
        if math.isclose(ratio, 1.0, rel_tol=1e-9):
            return self
        lengths = np.floor(self.lengths / ratio + 1e-9).astype(int)
        if lengths.min() < 1:
            shortest = int(lengths.argmin())
            raise TrajectoryError(
                f"Trajectory {shortest} lasts {self.lengths[shortest] * self.dt:g} s, less than "
                f"one step of {dt} s. Leave it out or choose a smaller dt."
            )
        pieces = [resample(*self.episode(i), ratio, int(n), angles) for i, n in enumerate(lengths)]
        changed = self.from_arrays(*_unzip(pieces), dt=dt, conditions=self.conditions)
        return dataclasses.replace(changed, origin=self.origin, report=self.report)

    def __repr__(self) -> str:
        lengths = np.sort(self.lengths)
        range_ = f"{lengths[0]}" if lengths[0] == lengths[-1] else f"{lengths[0]} to {lengths[-1]}"
        counts = [f"{label!r} ({n})" for label, n in Counter(self.conditions).items()]
        more = f", and {len(counts) - 4} more" if len(counts) > 4 else ""
        return (
            f"Trajectories: {len(self)} of {range_} steps, "
            f"{self.n_steps} steps or {self.n_steps * self.dt:.4g} s in all at dt = {self.dt:g} s\n"
            f"  channels: {self.n_obs} observed, {self.n_act} commanded\n"
            f"  conditions: {', '.join(counts[:4])}{more}"
        )


def _is_npz(path: Path) -> bool:
    """Whether it is the path of a single ``.npz`` file, with or without the suffix."""
    stored = path if path.suffix == ".npz" else path.with_name(path.name + ".npz")
    return stored.is_file() or (path.suffix == ".npz" and not glob.has_magic(str(path)))


def _unzip(
    episodes: Sequence[tuple[np.ndarray, np.ndarray]],
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    return [x for x, _ in episodes], [u for _, u in episodes]


def _flatten(data: Trajectories) -> tuple[Any, tuple[float, tuple[str, ...]]]:
    """Leaves with their keys, and the static fields."""
    leaves = tuple((jax.tree_util.GetAttrKey(name), getattr(data, name)) for name in _LEAVES)
    return leaves, (data.dt, data.conditions)


def _unflatten(static: tuple[float, tuple[str, ...]], leaves: Iterable[Any]) -> Trajectories:
    """Without checks: under ``vmap`` and ``tree.map``, leaves can be any object."""
    data = object.__new__(Trajectories)
    names = (*_LEAVES, "dt", "conditions", "report")
    for name, value in zip(names, (*leaves, *static, None), strict=True):
        object.__setattr__(data, name, value)
    return data


jax.tree_util.register_pytree_with_keys(Trajectories, _flatten, _unflatten)
