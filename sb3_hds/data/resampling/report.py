"""The report of what reading a log changed."""

import dataclasses
import math
import textwrap
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from sb3_hds.core.declarations import Actuator, Channel
from sb3_hds.core.trajectories.episodes import SAME_RATE
from sb3_hds.data.conversion import same_quantity
from sb3_hds.data.resampling.clock import Kind
from sb3_hds.data.resampling.rows import Rows

_LISTED = 20
_DRIFT = 1e-4  # relative change of a rate that is reported


@dataclasses.dataclass(frozen=True)
class Sampling:
    """
    The time stamps of one recording, and what was done to its rows.

    :param source: file, and episode where it holds several
    :param rows: number of rows
    :param intervals: shortest, median and longest time between two rows, without gaps [s]
    :param uneven: number of intervals that differ from the median by more than 10 %
    :param repeated: rows left out because they have the stamp of the row before
    :param gaps: row before which a gap lies, and its length [s]; the recording is cut there
    :param unused: number of rows left out because a piece between gaps is shorter than a step
    :param resampled: whether observations were interpolated
    :param moved: longest time from a sample to the row closest to it [s]
    :param error: of the rows, when they are interpolated back from the samples: root mean square,
        one per observation channel, in its unit
    :param clock: the kind of clock that paced the rows: ``"regular"``; ``"rounded"``, regular with
        stamps of few digits; ``"late"``, regular but for a few stamps; ``"jittered"``, regular with
        stamps whose errors do not add up; or ``"irregular"``
    :param interval: of that clock, or the median one [s]
    :param rounding: what all stamps are multiples of, otherwise 0 [s]
    :param off: largest distance of a stamp from its tick [s]
    :param jitter: root mean square of these distances [s]
    :param late: rows whose stamps are off, where these are few
    :param drift: relative change of the clock's rate
    :param missing: row before which rows are missing between two gaps, and how many; these samples
        were interpolated
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
    The rows that one trajectory was made of.

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
    What reading logs into ``Trajectories`` changed; prints itself.

    :param dt: sampling interval of the result [s]
    :param obs: names of the observation channels
    :param actions: names of the action channels
    :param resolution: smallest step of each observation channel whose rows are multiples of one,
        otherwise 0
    :param recordings: one for each that was read, in order; ``Trajectories.origin`` counts them
    :param parts: the rows as measured that each trajectory was made of, in order
    :param units: of the observation channels, as they are now; empty where unknown
    :param action_units: of the action channels, likewise
    :param notes: sentences on what was understood of the files themselves
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
        said = []
        for kind, say in _CLOCKS.items():
            for kept in (True, False):
                some = [r for r in self.recordings if (r.clock, not r.resampled) == (kind, kept)]
                if some:
                    said.append(f"{_place(some)}: {say(some, kept)}")
        rates = [1.0 / r.interval for r in self.recordings if r.clock != "irregular"]
        if rates and max(rates) > (1.0 + _DRIFT) * min(rates):
            said.append(
                f"Rates are {min(rates):.6g} to {max(rates):.6g} Hz; rows of those within "
                f"{100.0 * SAME_RATE:g} % of {1.0 / self.dt:.6g} Hz are kept"
            )
        drifts = [r.drift for r in self.recordings]
        if max(drifts) > _DRIFT:
            said.append(f"Within a recording, the rate changes by up to {100 * max(drifts):.2g} %")
        return ". ".join(said) + "."

    def summary(self) -> str:
        """:return: what was changed, in one sentence for each kind of change"""
        uneven = [r for r in self.recordings if r.resampled]
        repeated = [r for r in self.recordings if r.repeated]
        gaps = [r for r in self.recordings if r.gaps]
        filled = [r for r in self.recordings if r.missing]
        said = []
        if uneven:
            errors = [max(values) for values in zip(*(r.error for r in uneven), strict=True)]
            pairs = ", ".join(f"{n} {e:.2g}" for n, e in zip(self.obs, errors, strict=True))
            said.append(
                f"{_subject(uneven)} resampled to dt = {self.dt:g} s: rows were "
                f"{_ms(min(r.intervals[0] for r in uneven))} to "
                f"{_ms(max(r.intervals[2] for r in uneven))} apart, samples are up to "
                f"{_ms(max(r.moved for r in uneven))} from the closest row; interpolated back, "
                f"rows differ by (rms) {pairs}"
            )
        if filled:
            n = sum(rows for r in filled for _, rows in r.missing)
            said.append(
                f"In {_place(filled)}, {_counted(n, 'missing row')} "
                f"{'was' if n == 1 else 'were'} filled in by interpolation"
            )
        if repeated:
            n = sum(len(r.repeated) for r in repeated)
            said.append(
                f"In {_place(repeated)}, {_counted(n, 'row')} with the stamp of the row before "
                f"{'was' if n == 1 else 'were'} left out"
            )
        if gaps:
            n, unused = sum(len(r.gaps) for r in gaps), sum(r.unused for r in gaps)
            longest = max(length for r in gaps for _, length in r.gaps)
            left_out = f"; {_counted(unused, 'row')} in shorter pieces left out" if unused else ""
            said.append(
                f"{_subject(gaps)} cut at {_counted(n, 'gap')} of up to {longest:.3g} s{left_out}"
            )
        return ". ".join(said) + "." if said else "Nothing was changed."

    def misfit(self, channels: Sequence[Channel], actuators: Sequence[Actuator] = ()) -> str:
        """
        :param channels: of a twin
        :param actuators: of a twin
        :return: which channel was read in a unit of something else than the twin's, and the line
            to write; empty if there is none. What has no unit that is understood fits
        """
        read = (("obs", self.obs, self.units), ("actions", self.actions, self.action_units))
        for (key, names, units), wanted in zip(read, (channels, actuators), strict=True):
            for name, unit, target in zip(names, units, wanted, strict=False):
                if same_quantity(unit, target.unit) is False:
                    return (
                        f"'{name}' was read in {unit}, and '{target.name}' is in {target.unit}. "
                        "Either the columns are in another order than the channels, or their units "
                        f"are others: in the map of columns, {key}: [{{column: {name}, unit: "
                        f"{target.unit}}}]."
                    )
        return ""

    def to_dict(self) -> dict[str, Any]:
        """:return: plain data for JSON; what is not finite is None"""
        plain = dataclasses.asdict(dataclasses.replace(self, parts=()))
        return {name: _finite(value) for name, value in plain.items() if name != "parts"}

    def __str__(self) -> str:
        shown = self.recordings[:_LISTED]
        width = max(9, *(len(r.source) for r in shown))
        width = min(width, 34)
        lines = [
            f"Read {_counted(len(self.recordings), 'recording')} at dt = {self.dt:g} s",
            _row(width, "recording", "rows", "interval [ms]", "repeated", "gaps"),
        ]
        for r in shown:
            low, median, high = (f"{1e3 * value:.4g}" for value in r.intervals)
            interval = median if low == high else f"{low}..{median}..{high}"
            name = r.source if len(r.source) <= width else "..." + r.source[3 - width :]
            lines.append(_row(width, name, r.rows, interval, len(r.repeated), len(r.gaps)))
        if len(self.recordings) > _LISTED:
            lines.append(f"  and {len(self.recordings) - _LISTED} more")
        paragraphs = [self.clocks(), self.summary(), *self.notes]
        return "\n".join([*lines, *(line for text in paragraphs for line in _wrapped(text))])


def _regular(some: list[Sampling], kept: bool) -> str:
    return f"regular clock of {_hertz(some)}" + ("" if kept else ", resampled to another interval")


def _rounded(some: list[Sampling], kept: bool) -> str:
    return f"{_regular(some, kept)}, stamps rounded to {_ms(max(r.rounding for r in some))}"


def _late(some: list[Sampling], kept: bool) -> str:
    n, rows = sum(len(r.late) for r in some), sum(r.rows for r in some)
    return (
        f"clock of {_hertz(some)}, regular but for {n} of {_counted(rows, 'stamp')}, off by up to "
        f"{_ms(max(r.off for r in some))}; {_whether(kept, 'rows stay at their ticks')}"
    )


def _jittered(some: list[Sampling], kept: bool) -> str:
    return (
        f"clock of {_hertz(some)}, regular with stamps that jitter by "
        f"{_ms(max(r.jitter for r in some))} (rms); {_whether(kept, 'rows are kept')}"
    )


def _whether(kept: bool, said: str) -> str:
    values = f"{said}: their values fit these no worse"
    return values if kept else "rows were measured when the stamps say, as their values show"


def _irregular(some: list[Sampling], kept: bool) -> str:
    shortest, longest = min(r.intervals[0] for r in some), max(r.intervals[2] for r in some)
    return f"no regular clock, rows are {_ms(shortest)} to {_ms(longest)} apart"


_CLOCKS: dict[Kind, Callable[[list[Sampling], bool], str]] = {
    "regular": _regular,
    "rounded": _rounded,
    "late": _late,
    "jittered": _jittered,
    "irregular": _irregular,
}


def _hertz(some: list[Sampling]) -> str:
    rates = sorted(1.0 / r.interval for r in some)
    low, high = f"{rates[0]:.5g}", f"{rates[-1]:.5g}"
    return f"{low} Hz" if low == high else f"{low} to {high} Hz"


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _row(width: int, name: str, *values: Any) -> str:
    rows, interval, repeated, gaps = values
    return f"  {name:<{width}} {rows:>7} {interval:>21} {repeated:>8} {gaps:>4}"


def _place(recordings: list[Sampling]) -> str:
    return recordings[0].source if len(recordings) == 1 else f"{len(recordings)} recordings"


def _subject(recordings: list[Sampling]) -> str:
    return f"{_place(recordings)} {'was' if len(recordings) == 1 else 'were'}"


def _counted(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def _ms(seconds: float) -> str:
    return "?" if math.isnan(seconds) else f"{1e3 * seconds:.3g} ms"


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, 78, initial_indent="  ", subsequent_indent="  ")
