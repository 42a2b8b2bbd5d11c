"""Recordings that survive a crash of the process: one line for each step."""

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_hds.core.trajectories.episodes import check_dt
from sb3_hds.data.columns import Columns, Entry, Label
from sb3_hds.errors import TrajectoryError

_FORMAT, _VERSION, SUFFIX = "sb3_hds.Recording", 1, ".jsonl"
_RESERVED = ("time", "condition")
_NOT_RECORDED = "This was not recorded; earlier steps are unaffected."


class Recorder:
    """
    Records a running system, for ``Trajectories.load(path)``.

    Each call appends one line of JSON to the file and passes it to the operating system: a process
    that is killed loses at most the line that it was writing. Data are flushed to disk, to survive
    a power failure, only when an episode starts and at the end.

    **Action k acts from observation k to observation k + 1**: pass :meth:`step` the command and
    what was measured *after* it.

    :param path: ``.jsonl`` is appended if it is missing
    :param dt: intended sampling interval [s]; loading resamples to it
    :param obs: names of the observation channels
    :param actions: names of the action channels
    :param condition: label of the following episodes; may be changed at any time
    :param clock: returns the time [s], such as ``time.monotonic``, if the interval varies; default:
        steps are assumed to be exactly ``dt`` apart
    :param append: continue an existing file with the same channels; otherwise an existing file is
        an error
    :raises TrajectoryError: if the file cannot be written, exists, or has other channels
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        dt: float,
        *,
        obs: Sequence[str],
        actions: Sequence[str],
        condition: str = "default",
        clock: Callable[[], float] | None = None,
        append: bool = False,
    ) -> None:
        target = Path(path).expanduser()
        self.path = target if target.suffix == SUFFIX else target.with_name(target.name + SUFFIX)
        self.dt = check_dt(dt)
        self.condition = condition
        self._obs, self._actions = _names(obs, actions)
        self._clock = clock
        self._time: float | None = None
        header = {"format": _FORMAT, "version": _VERSION, "dt": self.dt}
        header |= {"obs": self._obs, "actions": self._actions}
        try:
            continued = append and self._truncate_partial_line(header)
            self._file = self.path.open("ab" if continued else "xb", buffering=0)
            if not continued:
                self._write(header)
        except FileExistsError as error:
            raise TrajectoryError(
                f"'{self.path}' exists; recordings are never overwritten. Choose another name, or "
                "continue it with append=True."
            ) from error
        except OSError as error:
            raise TrajectoryError(
                f"'{self.path}' could not be written: {error.strerror}. "
                "The folder must exist and be writable, with free space on the disk."
            ) from error

    def start(self, obs: Any, time: float | None = None) -> None:
        """
        Begin an episode.

        :param obs: the first observation, shape ``(n_obs,)``
        :param time: when it was measured [s]; default: the clock, or 0
        :raises TrajectoryError: for another shape, for numbers that are not finite, or after
            :meth:`close`
        """
        now = self._time_of(0.0, time)
        begun = {
            "time": now,
            "obs": _numbers("obs", obs, self._obs),
            "condition": str(self.condition),
        }
        self._write(begun)
        self._time = now
        os.fsync(self._file.fileno())

    def step(self, action: Any, obs: Any, time: float | None = None) -> None:
        """
        :param action: the command, shape ``(n_act,)``
        :param obs: what was measured after it, shape ``(n_obs,)``
        :param time: when that was measured [s]; default: the clock, or ``dt`` after the last one
        :raises TrajectoryError: for another shape, for numbers that are not finite, for time that
            decreases, before :meth:`start`, or after :meth:`close`; such a step is not recorded
        """
        if self._time is None:
            raise TrajectoryError("No episode has begun: call start(obs) first.")
        now = self._time_of(self._time + self.dt, time)
        if now < self._time:
            raise TrajectoryError(
                f"time must not decrease within an episode, got {now:g} s after {self._time:g} s. "
                f"If a new episode begins here, call start(obs). {_NOT_RECORDED}"
            )
        taken = _numbers("action", action, self._actions)
        self._write({"time": now, "action": taken, "obs": _numbers("obs", obs, self._obs)})
        self._time = now

    def close(self) -> None:
        """Flush the file to disk and close it. A second call does nothing."""
        if not self._file.closed:
            os.fsync(self._file.fileno())
            self._file.close()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _time_of(self, otherwise: float, given: float | None) -> float:
        """The given time, or else that of the clock."""
        if given is None:
            given = otherwise if self._clock is None else self._clock()
        return _numbers("time", given, ["time"])[0]

    def _write(self, line: dict[str, Any]) -> None:
        if self._file.closed:
            raise TrajectoryError(f"The recording '{self.path}' is closed.")
        text = (json.dumps(line, separators=(",", ":")) + "\n").encode()
        if self._file.write(text) < len(text):
            raise TrajectoryError(f"'{self.path}' could not be written: the disk is full.")

    def _truncate_partial_line(self, header: dict[str, Any]) -> bool:
        """Whether there is a file to continue; removes an incomplete last line."""
        if not self.path.exists():
            return False
        content = self.path.read_bytes()
        end = content.rfind(b"\n") + 1
        if not end:
            beginning = (json.dumps(header, separators=(",", ":")) + "\n").encode()
            if not beginning.startswith(content):
                raise TrajectoryError(
                    f"'{self.path}' is not a recording: it begins with {content[:60]!r}. Choose "
                    "another file."
                )
            self.path.unlink()
            return False
        earlier = _parse(content.partition(b"\n")[0], self.path, 1)
        if earlier != header:
            raise TrajectoryError(
                f"'{self.path}' has a different interval or different channels and cannot be "
                f"continued: {earlier}, now {header}."
            )
        os.truncate(self.path, end)
        return True


def is_recording(line: bytes) -> bool:
    """:return: whether this first line is the header of a :class:`Recorder` file"""
    try:
        header = json.loads(line)
    except (ValueError, RecursionError):
        return False
    return isinstance(header, dict) and header.get("format") == _FORMAT


def read_recording(path: Path) -> tuple[list[dict[str, np.ndarray]], Columns]:
    """
    :param path: of a file that a :class:`Recorder` wrote or is writing
    :return: one table per episode with at least one step, and the meaning of their columns
    :raises TrajectoryError: if it is not a recording or damaged; an incomplete last line is ignored
    """
    *lines, incomplete = path.read_bytes().split(b"\n")
    header = _parse(lines[0], path, 1) if lines else {}
    if header.get("format") != _FORMAT:
        raise TrajectoryError(
            f"'{path}' is not a recording, or was interrupted before its first line was written: "
            f"it begins with {(lines or [incomplete])[0][:60]!r}."
        )
    _check_header(header, path)
    if header["version"] > _VERSION:
        raise TrajectoryError(
            f"'{path}' has version {header['version']}; this sb3_hds reads up to {_VERSION}. "
            "Upgrade sb3_hds."
        )
    episodes: list[list[dict[str, Any]]] = []
    for number, line in enumerate(lines[1:], start=2):
        row = _parse(line, path, number)
        if "action" not in row:
            episodes.append([])
        if not episodes:
            raise _damaged(path, number, "a step before the start of an episode")
        episodes[-1].append(row)
    tables = [_table(rows, header, path) for rows in episodes if len(rows) > 1]
    if not tables:
        raise TrajectoryError(f"The recording '{path}' contains no step yet.")
    return tables, Columns(
        obs=tuple(Entry(name, name) for name in header["obs"]),
        actions=tuple(Entry(name, name) for name in header["actions"]),
        time=(Entry("time", "time"),),
        condition=Label("condition"),
        dt=header["dt"],
    )


def _check_header(header: dict[str, Any], path: Path) -> None:
    obs, actions = header.get("obs"), header.get("actions")
    numbers = all(isinstance(header.get(key), int | float) for key in ("version", "dt"))
    if not (isinstance(obs, list) and isinstance(actions, list) and numbers):
        raise _damaged(path, 1, "it lacks version, dt, obs or actions")
    check_dt(header["dt"])
    _names(obs, actions)


def _table(rows: list[dict[str, Any]], header: dict[str, Any], path: Path) -> dict[str, np.ndarray]:
    """Columns of one episode. Row k has the action that follows it; the last row has none."""
    n, n_act = len(rows), len(header["actions"])
    try:
        obs = np.array([row["obs"] for row in rows], float).reshape(n, len(header["obs"]))
        actions = np.full((n, n_act), np.nan)
        actions[:-1] = np.array([row["action"] for row in rows[1:]], float).reshape(n - 1, n_act)
        names = [*header["obs"], *header["actions"]]
        columns = dict(zip(names, np.hstack([obs, actions]).T, strict=True))
        times = np.array([row["time"] for row in rows], float)
        return columns | {"time": times, "condition": np.array(str(rows[0]["condition"]))}
    except (KeyError, ValueError, TypeError) as error:
        raise TrajectoryError(
            f"An episode of '{path}' does not fit its header ({error}). Restore it from a copy."
        ) from error


def _parse(line: bytes, path: Path, number: int) -> dict[str, Any]:
    try:
        row = json.loads(line)
        if not isinstance(row, dict):
            raise ValueError("no object")
        return row
    except ValueError as error:
        raise _damaged(path, number, str(error)) from error


def _damaged(path: Path, number: int, reason: str) -> TrajectoryError:
    return TrajectoryError(
        f"Line {number} of '{path}' is damaged ({reason}). Restore the file from a copy, or remove "
        "that line and, up to the next line with a condition, those after it."
    )


def _names(obs: Sequence[str], actions: Sequence[str]) -> tuple[list[str], list[str]]:
    for argument, names in (("obs", obs), ("actions", actions)):
        if isinstance(names, str) or not all(isinstance(name, str) for name in names):
            raise TrajectoryError(f"{argument} must be a list of names, got {names!r}.")
    used = [*obs, *actions]
    if not obs or len({*used, *_RESERVED}) < len(used) + len(_RESERVED):
        raise TrajectoryError(
            "A recording needs at least one observation channel, and a name of its own for each "
            f"channel, other than {' and '.join(_RESERVED)}; got obs {list(obs)} and actions "
            f"{list(actions)}."
        )
    return list(obs), list(actions)


def _numbers(argument: str, values: Any, names: list[str]) -> list[float]:
    try:
        row = np.asarray(values, float).ravel()
    except (TypeError, ValueError) as error:
        raise TrajectoryError(
            f"{argument} must hold numbers ({', '.join(names)}), got {values!r}. {_NOT_RECORDED}"
        ) from error
    if len(row) != len(names):
        raise TrajectoryError(
            f"{argument} must have {len(names)} numbers ({', '.join(names)}), got shape "
            f"{np.shape(values)}."
        )
    if not np.isfinite(row).all():
        raise TrajectoryError(
            f"{argument} must be finite ({', '.join(names)}), got {values!r}: the file could not "
            f"be loaded. If a measurement is missing, begin a new episode after it: start(obs). "
            f"{_NOT_RECORDED}"
        )
    return row.tolist()
