"""The report of how logs were read and resampled."""

import dataclasses
import itertools
import math
import textwrap
from collections.abc import Sequence
from typing import Any, NamedTuple, get_args

import numpy as np

from sb3_hds.core.declarations import Actuator, Channel
from sb3_hds.core.trajectories.episodes import SAME_RATE
from sb3_hds.data.conversion import same_quantity
from sb3_hds.data.resampling.clock import Kind
from sb3_hds.data.resampling.rows import Rows
from sb3_hds.data.wording import counted

_LISTED = 20
_FEW_CHANNELS = 4
_DRIFT = 1e-4  # relative change of a rate that is reported


@dataclasses.dataclass(frozen=True)
class Sampling:
    """
    The time stamps of one recording, and how its rows were processed.

    :param source: file, and episode where it holds several
    :param rows: number of rows
    :param intervals: shortest, median and longest time between two rows, without gaps [s]
    :param uneven: number of intervals that differ from the median by more than 10 %
    :param repeated: rows dropped because they have the stamp of the previous row
    :param gaps: row after each gap, and its length [s]; the recording is cut there
    :param unused: number of rows dropped because a part between gaps is shorter than a step
    :param resampled: whether observations were interpolated
    :param moved: longest time from a sample to the closest row [s]
    :param error: root-mean-square difference of the rows from the samples interpolated back to
        them, for each observation channel in its unit
    :param clock: the kind of clock that paced the rows: ``"regular"``; ``"rounded"``, regular with
        stamps of few digits; ``"late"``, regular except for a few stamps; ``"jittered"``, regular
        with stamp errors that do not accumulate; or ``"irregular"``
    :param interval: of that clock, or the median one [s]
    :param rounding: resolution of the stamps, 0 if they are not rounded [s]
    :param off: largest distance of a stamp from its tick [s]
    :param jitter: root mean square of these distances [s]
    :param late: rows whose stamps are off, if these are few
    :param drift: relative change of the clock's rate
    :param missing: row before which rows are missing between two gaps, and how many; these were
        interpolated
    """

    source: str
    rows: int
    intervals: tuple[float, float, float]
    uneven: int
    repeated: tuple[int, ...]
    gaps: tuple[tuple[int, float], ...]
    unused: int
    resampled: bool
    moved: float
    error: tuple[float, ...]
    clock: Kind = "regular"
    interval: float = math.nan
    rounding: float = 0.0
    off: float = 0.0
    jitter: float = 0.0
    late: tuple[int, ...] = ()
    drift: float = 0.0
    missing: tuple[tuple[int, int], ...] = ()

    @property
    def altered(self) -> bool:
        """Whether the samples differ from the rows."""
        return self.resampled or bool(self.repeated or self.gaps or self.missing)


class Part(NamedTuple):
    """
    The rows of a log from which one trajectory was made.

    :param recording: number of the recording
    :param rows: without gaps and repeated stamps
    :param begin: time of the first sample, on the clock of the rows [s]
    :param n_steps: of the trajectory
    """

    recording: int
    rows: Rows
    begin: float
    n_steps: int


@dataclasses.dataclass(frozen=True)
class Reading:
    """
    How logs were processed into ``Trajectories``; prints itself.

    :param dt: sampling interval of the result [s]
    :param obs: names of the observation channels
    :param actions: names of the action channels
    :param resolution: smallest step of each quantised observation channel, otherwise 0
    :param recordings: in the order of the files; ``Trajectories.origin`` counts them
    :param parts: the measured rows of each trajectory, in order
    :param units: of the observation channels after conversion; empty if unknown
    :param action_units: of the action channels after conversion; empty if unknown
    :param notes: sentences on what the files declare, such as units
    """

    dt: float
    obs: tuple[str, ...]
    actions: tuple[str, ...]
    resolution: tuple[float, ...]
    recordings: tuple[Sampling, ...]
    parts: tuple[Part, ...] = dataclasses.field(default=(), repr=False, compare=False)
    units: tuple[str, ...] = ()
    action_units: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def altered(self) -> bool:
        """Whether any sample differs from the files."""
        return any(recording.altered for recording in self.recordings)

    def clocks(self) -> str:
        """:return: the clocks that paced the rows, one sentence for each kind"""
        found = []
        for kind, kept in itertools.product(get_args(Kind), (True, False)):
            group = [r for r in self.recordings if (r.clock, not r.resampled) == (kind, kept)]
            if group:
                found.append(f"{_subject(group)}: {_clock(kind, group, kept)}")
        rates = [1.0 / r.interval for r in self.recordings if r.clock != "irregular"]
        if rates and max(rates) > (1.0 + _DRIFT) * min(rates):
            found.append(
                f"Rates are {min(rates):.6g} to {max(rates):.6g} Hz; rows of those within "
                f"{100.0 * SAME_RATE:g} % of {1.0 / self.dt:.6g} Hz are kept"
            )
        drifts = [r.drift for r in self.recordings]
        if max(drifts) > _DRIFT:
            found.append(f"Within a recording, the rate changes by up to {100 * max(drifts):.2g} %")
        return ". ".join(found) + "."

    def summary(self) -> str:
        """:return: what was changed, in one sentence for each kind of change"""
        uneven = [r for r in self.recordings if r.resampled]
        repeated = [r for r in self.recordings if r.repeated]
        gaps = [r for r in self.recordings if r.gaps]
        filled = [r for r in self.recordings if r.missing]
        found = []
        if uneven:
            found.append(
                f"{_subject_were(uneven)} resampled to dt = {self.dt:g} s: rows were "
                f"{_ms(min(r.intervals[0] for r in uneven))} to "
                f"{_ms(max(r.intervals[2] for r in uneven))} apart, samples are up to "
                f"{_ms(max(r.moved for r in uneven))} from the closest row; interpolated back, "
                f"the rms differences from the rows are {self._errors(uneven)}"
            )
        if filled:
            n = sum(rows for r in filled for _, rows in r.missing)
            found.append(
                f"In {_subject(filled)}, {counted(n, 'missing row was', 'missing rows were')} "
                "filled in by interpolation"
            )
        if repeated:
            n = sum(len(r.repeated) for r in repeated)
            found.append(
                f"In {_subject(repeated)}, {counted(n, 'row')} with the stamp of the previous row "
                f"{'was' if n == 1 else 'were'} dropped"
            )
        if gaps:
            n, unused = sum(len(r.gaps) for r in gaps), sum(r.unused for r in gaps)
            longest = max(length for r in gaps for _, length in r.gaps)
            short = f"; {counted(unused, 'row')} in shorter parts dropped" if unused else ""
            found.append(
                f"{_subject_were(gaps)} cut at {counted(n, 'gap')} of up to {longest:.3g} s{short}"
            )
        return ". ".join(found) + "." if found else "Nothing was changed."

    def _errors(self, uneven: list[Sampling]) -> str:
        """Errors of interpolation: of a few channels all, of many the largest one."""
        errors = [max(values) for values in zip(*(r.error for r in uneven), strict=True)]
        named = [f"{name} {error:.2g}" for name, error in zip(self.obs, errors, strict=True)]
        if len(named) <= _FEW_CHANNELS or not self.parts:
            return ", ".join(named)
        deviations = np.max([np.std(part.rows.obs, axis=0) for part in self.parts], axis=0)
        shares = np.array(errors) / np.where(deviations > 0.0, deviations, np.inf)
        worst = int(np.argmax(shares))
        return (
            f"at most {100.0 * shares[worst]:.2g} % of a channel's standard deviation "
            f"({named[worst]})"
        )

    def misfit(self, channels: Sequence[Channel], actuators: Sequence[Actuator] = ()) -> str:
        """
        :param channels: of a twin
        :param actuators: of a twin
        :return: an error message if a channel was read in a unit of another quantity than the
            twin's; empty if there is none. Unknown units are accepted
        """
        read = (("obs", self.obs, self.units), ("actions", self.actions, self.action_units))
        for (key, names, units), wanted in zip(read, (channels, actuators), strict=True):
            for name, unit, target in zip(names, units, wanted, strict=False):
                if same_quantity(unit, target.unit) is False:
                    return (
                        f"'{name}' was read in {unit}, and '{target.name}' is in {target.unit}. "
                        "Either the columns are not in the order of the channels, or their units "
                        f"are wrong: in the map of columns, {key}: [{{column: {name}, unit: "
                        f"{target.unit}}}]."
                    )
        return ""

    def to_dict(self) -> dict[str, Any]:
        """:return: plain data for JSON; non-finite numbers are None"""
        plain = dataclasses.asdict(dataclasses.replace(self, parts=()))
        return {name: _finite(value) for name, value in plain.items() if name != "parts"}

    def __str__(self) -> str:
        shown = self.recordings[:_LISTED]
        width = min(max(9, *(len(r.source) for r in shown)), 34)
        row = f"  {{:<{width}}} {{:>7}} {{:>21}} {{:>8}} {{:>4}}".format
        lines = [
            f"Read {counted(len(self.recordings), 'recording')} at dt = {self.dt:g} s",
            row("recording", "rows", "interval [ms]", "repeated", "gaps"),
        ]
        for r in shown:
            low, median, high = (f"{1e3 * value:.4g}" for value in r.intervals)
            interval = median if low == high else f"{low}..{median}..{high}"
            name = r.source if len(r.source) <= width else "..." + r.source[3 - width :]
            lines.append(row(name, r.rows, interval, len(r.repeated), len(r.gaps)))
        if len(self.recordings) > _LISTED:
            lines.append(f"  and {len(self.recordings) - _LISTED} more")
        for text in (self.clocks(), self.summary(), *self.notes):
            lines += textwrap.wrap(text, 78, initial_indent="  ", subsequent_indent="  ")
        return "\n".join(lines)


def _clock(kind: Kind, group: list[Sampling], kept: bool) -> str:
    """The clock of group recordings in words, and whether their rows were kept."""
    rates = sorted(1.0 / r.interval for r in group)
    low, high = f"{rates[0]:.5g}", f"{rates[-1]:.5g}"
    clock = f"clock of {low} Hz" if low == high else f"clock of {low} to {high} Hz"
    regular = f"regular {clock}" + ("" if kept else ", resampled to another interval")
    stamps_hold = "values show that rows were measured at their stamps"
    ticks_hold = "rows are kept at their ticks, with which their values are consistent"
    holds = ticks_hold if kept else stamps_hold
    off, jitter = _ms(max(r.off for r in group)), _ms(max(r.jitter for r in group))
    match kind:
        case "regular":
            return regular
        case "rounded":
            return f"{regular}, stamps rounded to {_ms(max(r.rounding for r in group))}"
        case "late":
            n_late = sum(len(r.late) for r in group)
            stamps = counted(sum(r.rows for r in group), "stamp")
            return f"{clock}, regular except for {n_late} of {stamps}, off by up to {off}; {holds}"
        case "jittered":
            return f"{clock}, regular with stamps that jitter by {jitter} (rms); {holds}"
        case "irregular":
            shortest = _ms(min(r.intervals[0] for r in group))
            longest = _ms(max(r.intervals[2] for r in group))
            return f"no regular clock, rows are {shortest} to {longest} apart"


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _subject(recordings: list[Sampling]) -> str:
    return recordings[0].source if len(recordings) == 1 else f"{len(recordings)} recordings"


def _subject_were(recordings: list[Sampling]) -> str:
    return f"{_subject(recordings)} {'was' if len(recordings) == 1 else 'were'}"


def _ms(seconds: float) -> str:
    return "?" if math.isnan(seconds) else f"{1e3 * seconds:.3g} ms"
