"""Defects of time stamps: uneven, jittered, repeated, missing."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from sb3_hds.core.trajectories import Trajectories
from sb3_hds.data.audit.finding import Finding, Place
from sb3_hds.data.resampling.report import Reading, Sampling
from sb3_hds.data.wording import counted, percent


@dataclasses.dataclass(frozen=True)
class UnevenSampling(Finding):
    """
    :param shortest: shortest interval between two rows [s]
    :param median: median interval [s]
    :param longest: longest interval [s]
    :param share: of the intervals that differ from the median by more than 10 %
    """

    shortest: float
    median: float
    longest: float
    share: float

    @property
    def sentence(self) -> str:
        return (
            f"Time stamps jitter: rows are {1e3 * self.shortest:.3g} to "
            f"{1e3 * self.longest:.3g} ms apart, the median is {1e3 * self.median:.3g} ms and "
            f"{percent(self.share)} differ from it by more than 10 % ({self.recordings})."
        )

    remedy = (
        "The rows were resampled; compare the interpolation error, which the report of the "
        "reading states, with the noise. In future recordings, trigger command and measurement by "
        "one clock."
    )


@dataclasses.dataclass(frozen=True)
class JitteredStamps(Finding):
    """
    Stamps that deviate from the ticks of a regular clock.

    :param n_rows: number of rows whose stamps deviate, if these are few; otherwise 0
    :param longest: largest deviation [s]
    :param rms: root mean square of the deviations [s]
    """

    n_rows: int
    longest: float
    rms: float

    @property
    def sentence(self) -> str:
        far = f"up to {1e3 * self.longest:.3g} ms"
        if self.n_rows:
            return (
                f"{counted(self.n_rows, 'time stamp is', 'time stamps are')} off by {far} in an "
                f"otherwise regular clock ({self.where})."
            )
        return (
            f"Time stamps jitter by {1e3 * self.rms:.3g} ms (rms), {far}, around the ticks of a "
            f"regular clock ({self.recordings})."
        )

    remedy = (
        "The rows were assigned to the ticks, with which their values are consistent. In future "
        "recordings, use time stamps of the sensor's own clock."
    )


@dataclasses.dataclass(frozen=True)
class MissingRows(Finding):
    """:param n_rows: number of rows that are missing between rows of a regular clock"""

    n_rows: int

    @property
    def sentence(self) -> str:
        return (
            f"{counted(self.n_rows, 'row of a regular clock is', 'rows of a regular clock are')} "
            f"missing, before {self.where}."
        )

    remedy = "They were interpolated. Longer gaps end the trajectory: set gap: SECONDS in columns."


@dataclasses.dataclass(frozen=True)
class RepeatedStamps(Finding):
    """:param n_rows: number of rows that were dropped"""

    n_rows: int

    @property
    def sentence(self) -> str:
        return (
            f"{counted(self.n_rows, 'row')} with the time stamp of the previous row "
            f"{'was' if self.n_rows == 1 else 'were'} dropped ({self.where})."
        )

    remedy = "Check whether the logger writes rows twice or its clock is too coarse."


@dataclasses.dataclass(frozen=True)
class Gaps(Finding):
    """:param longest: longest gap [s]"""

    longest: float

    @property
    def sentence(self) -> str:
        return (
            f"The recording has {counted(len(self.places), 'gap')} of up to {self.longest:.3g} s "
            f"({self.where})."
        )

    remedy = "It was cut there. Find out what delayed the logger."


def timing(data: Trajectories, report: Reading | None) -> list[Finding]:
    """
    :param data: some or all of the recordings that were read
    :param report: of how they were read; None: without time stamps
    """
    if report is None:
        return []
    trajectory_of = {o: i for i, o in reversed(list(enumerate(data.origin.tolist())))}
    read = [(trajectory_of[o], r) for o, r in enumerate(report.recordings) if o in trajectory_of]
    found: list[Finding] = []
    uneven = [(i, r) for i, r in read if r.resampled and r.uneven]
    if uneven:
        found.append(
            UnevenSampling(
                "time",
                _all_rows(uneven),
                min(r.intervals[0] for _, r in uneven),
                float(np.median([r.intervals[1] for _, r in uneven])),
                max(r.intervals[2] for _, r in uneven),
                sum(r.uneven for _, r in uneven) / sum(r.rows - 1 for _, r in uneven),
            )
        )
    for kind in ("late", "jittered"):
        some = [(i, r) for i, r in read if r.clock == kind and not r.resampled]
        if some:
            late = tuple(Place(r.source, k, k, i) for i, r in some for k in r.late)
            found.append(
                JitteredStamps(
                    "time",
                    late if kind == "late" else _all_rows(some),
                    len(late) if kind == "late" else 0,
                    max(r.off for _, r in some),
                    max(r.jitter for _, r in some),
                )
            )
    holes = [(Place(r.source, k, k, i), n) for i, r in read for k, n in r.missing]
    if holes:
        found.append(MissingRows("time", tuple(p for p, _ in holes), sum(n for _, n in holes)))
    stamps = tuple(Place(r.source, k, k, i) for i, r in read for k in r.repeated)
    if stamps:
        found.append(RepeatedStamps("time", stamps, len(stamps)))
    gaps = [(Place(r.source, k, k, i), seconds) for i, r in read for k, seconds in r.gaps]
    if gaps:
        found.append(Gaps("time", tuple(place for place, _ in gaps), max(s for _, s in gaps)))
    return found


def _all_rows(read: Sequence[tuple[int, Sampling]]) -> tuple[Place, ...]:
    return tuple(Place(r.source, 0, r.rows - 1, i) for i, r in read)
