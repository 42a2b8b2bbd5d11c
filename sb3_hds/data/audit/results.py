"""The result of an audit, and how it prints."""

import dataclasses
import math
import textwrap
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any, TypeVar

import numpy as np

from sb3_hds.core.trajectories import Trajectories
from sb3_hds.data.audit.finding import Finding
from sb3_hds.data.audit.jumps import Outliers, ReinitialisedState
from sb3_hds.data.audit.velocity import VelocityShift
from sb3_hds.data.wording import counted, percent
from sb3_hds.errors import TrajectoryError

_WIDTH = 80
_ON_GRID = 0.02  # samples
_Kind = TypeVar("_Kind", bound=Finding)


@dataclasses.dataclass(frozen=True)
class ChannelSummary:
    """
    :param name: of the observation channel
    :param unit: empty if unknown
    :param lowest: measured value
    :param highest: measured value
    :param noise: standard deviation at rest; None if the system never rests
    :param resolution: smallest step of a quantised channel, otherwise 0
    """

    name: str
    unit: str
    lowest: float
    highest: float
    noise: float | None
    resolution: float


@dataclasses.dataclass(frozen=True)
class Audit:
    """
    The result of an audit. Prints itself.

    :param findings: defects, the most serious first
    :param channels: summaries of the observation channels
    :param stands_still: share of the time during which nothing moves beyond noise
    :param conditions: labels of the data
    :param lengths: number of steps of each trajectory
    :param dt: sampling interval [s]
    :param stamps: whether time stamps of rows were available
    """

    findings: tuple[Finding, ...]
    channels: tuple[ChannelSummary, ...]
    stands_still: float
    conditions: tuple[str, ...]
    lengths: tuple[int, ...]
    dt: float
    stamps: bool

    @property
    def usable(self) -> bool:
        """Whether the data can support a verdict."""
        return not any(finding.blocks for finding in self.findings)

    @property
    def reason(self) -> str:
        """Why they cannot, and what to record instead; empty if ``usable``."""
        return " ".join(str(finding) for finding in self.findings if finding.blocks)

    @property
    def velocity_shift(self) -> dict[str, float]:
        """Delay of each shifted velocity channel [s]; negative: early."""
        return {shift.channel: shift.seconds for shift in self._of_kind(VelocityShift)}

    @property
    def noise(self) -> dict[str, float | None]:
        """Standard deviation of each channel at rest, in its unit; None if it never rests."""
        return {channel.name: channel.noise for channel in self.channels}

    def corrected(self, data: Trajectories) -> Trajectories:
        """
        Cut at resets of the state, cut out outliers, and undo shifts of velocities. Audit the
        result again: outliers may have hidden other defects.

        :param data: the audited data
        :return: new trajectories; the same ones if there is nothing to correct
        :raises TrajectoryError: for other data, or if an episode is shorter than the shifts
        """
        if tuple(data.lengths.tolist()) != self.lengths or data.dt != self.dt:
            raise TrajectoryError("These are not the data of this audit: call audit(data) first.")
        jumps, far = self._of_kind(ReinitialisedState), self._of_kind(Outliers)
        places = [(p.trajectory, p.before, p.time) for jump in jumps for p in jump.places]
        places += [(p.trajectory, p.before, p.after) for outlier in far for p in outlier.places]
        if places:
            data = cut(data, places)
        names = [channel.name for channel in self.channels]
        lags = {names.index(s.channel): s.samples for s in self._of_kind(VelocityShift)}
        return shifted(data, lags) if lags else data

    @property
    def corrections(self) -> tuple[str, ...]:
        """Sentences on the corrections of :meth:`corrected`."""
        jumps = sum(len(jump.places) for jump in self._of_kind(ReinitialisedState))
        cuts = (f"The data were cut at {counted(jumps, 'jump')} of the state.",) if jumps else ()
        far = sum(len(outlier.places) for outlier in self._of_kind(Outliers))
        cuts += (f"Samples were cut out at {counted(far, 'place')} with outliers.",) if far else ()
        return cuts + tuple(
            f"'{channel}' was shifted by {-1e3 * seconds:+.3g} ms."
            for channel, seconds in self.velocity_shift.items()
        )

    def _of_kind(self, kind: type[_Kind]) -> list[_Kind]:
        return [finding for finding in self.findings if isinstance(finding, kind)]

    def to_dict(self) -> dict[str, Any]:
        """:return: plain data for JSON"""
        return {
            "usable": self.usable,
            "reason": self.reason,
            "n_trajectories": len(self.lengths),
            "n_steps": sum(self.lengths),
            "dt": self.dt,
            "conditions": sorted(set(self.conditions)),
            "stands_still": self.stands_still,
            "channels": [dataclasses.asdict(channel) for channel in self.channels],
            "velocity_shift": self.velocity_shift,
            "findings": [finding.to_dict() for finding in self.findings],
        }

    def __str__(self) -> str:
        n, steps, labels = len(self.lengths), sum(self.lengths), len(set(self.conditions))
        verdict = "yes" if self.usable else f"NO. {self.reason}"
        head = (
            f"Audit of {counted(n, 'trajectory', 'trajectories')}, "
            f"{counted(labels, 'condition')}: {steps} steps, {steps * self.dt:.4g} s at dt = "
            f"{self.dt:g} s"
        )
        lines = [head, *_wrapped(f"usable: {verdict}", "", "  "), "", *_table(self.channels)]
        lines += ["", f"The system stands still {percent(self.stands_still)} of the time."]
        lines += ["", "Findings:" if self.findings else "No defects were found."]
        for number, finding in enumerate(self.findings, start=1):
            lines += _wrapped(f"{number}. {finding.sentence}", "  ", "     ")
            lines += _wrapped(f"-> {finding.remedy}", "     ", "        ")
        if not self.stamps:
            lines += ["", "Time stamps were not checked: these data have none."]
        return "\n".join(lines)


def _table(channels: Sequence[ChannelSummary]) -> list[str]:
    names = [f"{c.name} [{c.unit}]" if c.unit else c.name for c in channels]
    width = min(max(len("channel"), *map(len, names)), 30)
    lines = [f"  {'channel':<{width}} {'lowest':>10} {'highest':>10} {'noise':>10} {'step':>10}"]
    for name, c in zip(names, channels, strict=True):
        noise = "?" if c.noise is None else f"{c.noise:.3g}"
        step = f"{c.resolution:.3g}" if c.resolution else "-"
        shown = name if len(name) <= width else name[: width - 3] + "..."
        lines.append(
            f"  {shown:<{width}} {c.lowest:>10.4g} {c.highest:>10.4g} {noise:>10} {step:>10}"
        )
    lines.append("  noise: standard deviation at rest; step: of quantised values")
    return lines


def _wrapped(text: str, first: str, rest: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent=first, subsequent_indent=rest)


def shifted(data: Trajectories, shifts: Mapping[int, float]) -> Trajectories:
    """
    Shift channels in time by linear interpolation; samples at the ends of an episode that then
    lack a channel are dropped.

    :param data: at one interval
    :param shifts: delay of each observation channel, by index [samples]; negative: early
    :raises TrajectoryError: if an episode is no longer than its shifts
    """
    before = max([0, *(math.ceil(-lag) for lag in shifts.values())])
    after = max([0, *(math.ceil(lag) for lag in shifts.values())])
    if data.lengths.min() <= before + after:
        shortest = int(data.lengths.argmin())
        raise TrajectoryError(
            f"Trajectory {shortest} has {data.lengths[shortest]} steps, too few for shifts that "
            f"drop {before + after} of them. Remove it: data[data.lengths > {before + after}]."
        )
    obs, actions = [], []
    for i, n in enumerate(data.lengths):
        x, u = data.episode(i)
        rows, moved = np.arange(len(x)), x.copy()
        for channel, lag in shifts.items():
            moved[:, channel] = np.interp(rows + lag, rows, x[:, channel])
        obs.append(moved[before : len(x) - after])
        actions.append(u[before : n - after])
    return _with_labels_of(data, obs, actions, range(len(data)))


def cut(data: Trajectories, places: Sequence[tuple[int, float, float]]) -> Trajectories:
    """
    Cut episodes at resets, and cut samples out; parts without a step are dropped.

    :param data: at one interval
    :param places: trajectory, and the times of the last sample before and the first one after the
        cut, since its beginning [s]
    """
    obs, actions, sources = [], [], []
    for i, n in enumerate(data.lengths):
        x, u = data.episode(i)
        here = sorted((last, first) for trajectory, last, first in places if trajectory == i)
        ends = [math.floor(last / data.dt + _ON_GRID) + 1 for last, _ in here]
        begins = list(accumulate((math.ceil(first / data.dt - _ON_GRID) for _, first in here), max))
        for a, b in zip([0, *begins], [*ends, int(n) + 1], strict=True):
            if b - a > 1:  # the result of the action before the cut was not measured
                obs.append(x[a:b])
                actions.append(u[a : b - 1])
                sources.append(i)
    if not obs:
        raise TrajectoryError("No part between the cuts has a step. Inspect the recording.")
    return _with_labels_of(data, obs, actions, sources)


def _with_labels_of(
    data: Trajectories,
    obs: Sequence[np.ndarray],
    actions: Sequence[np.ndarray],
    sources: Sequence[int],
) -> Trajectories:
    """New trajectories with the labels of their sources, without the rows of the log."""
    labels = [data.conditions[i] for i in sources]
    made = Trajectories.from_arrays(obs, actions, dt=data.dt, conditions=labels)
    report = data.report
    return dataclasses.replace(
        made,
        origin=data.origin[list(sources)],
        report=report and dataclasses.replace(report, parts=()),
    )
