"""The kinds of defects that an audit finds."""

import dataclasses

from sb3_hds.data.audit.finding import Finding, counted, listed, percent, recordings


def _are(n: int) -> str:
    return "is" if n == 1 else "are"


@dataclasses.dataclass(frozen=True)
class UnevenSampling(Finding):
    """
    :param shortest: interval between two rows [s]
    :param median: [s]
    :param longest: [s]
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
            f"{percent(self.share)} differ from it by more than 10 % ({recordings(self.places)})."
        )

    remedy = (
        "The rows were resampled; compare the error of that (print data.report) with the noise. "
        "Next time, let one clock trigger command and measurement."
    )


@dataclasses.dataclass(frozen=True)
class JitteredStamps(Finding):
    """
    Of a regular clock.

    :param n_rows: whose stamps are off, where these are few; otherwise 0
    :param longest: farthest that a stamp is off [s]
    :param rms: root mean square of how far stamps are off [s]
    """

    n_rows: int
    longest: float
    rms: float

    @property
    def sentence(self) -> str:
        far = f"up to {1e3 * self.longest:.3g} ms"
        if self.n_rows:
            return (
                f"{counted(self.n_rows, 'time stamp')} {_are(self.n_rows)} off by {far} in an "
                f"otherwise regular clock ({listed(self.places)})."
            )
        return (
            f"Time stamps jitter by {1e3 * self.rms:.3g} ms (rms), {far}, around the ticks of a "
            f"regular clock ({recordings(self.places)})."
        )

    remedy = (
        "The rows were kept at their ticks, which their values fit no worse. Next time, let the "
        "sensor's own clock stamp them."
    )


@dataclasses.dataclass(frozen=True)
class MissingRows(Finding):
    """:param n_rows: that are missing between rows of a regular clock"""

    n_rows: int

    @property
    def sentence(self) -> str:
        return (
            f"{counted(self.n_rows, 'row')} of a regular clock {_are(self.n_rows)} missing, before "
            f"{listed(self.places)}."
        )

    remedy = "Interpolated. A longer gap ends the trajectory: gap: SECONDS in columns says when."


@dataclasses.dataclass(frozen=True)
class RepeatedStamps(Finding):
    """:param n_rows: rows that were left out"""

    n_rows: int

    @property
    def sentence(self) -> str:
        return (
            f"{counted(self.n_rows, 'row')} with the time stamp of the row before "
            f"{'was' if self.n_rows == 1 else 'were'} left out ({listed(self.places)})."
        )

    remedy = "Find out whether the logger writes twice or the clock is too coarse."


@dataclasses.dataclass(frozen=True)
class Gaps(Finding):
    """:param longest: [s]"""

    longest: float

    @property
    def sentence(self) -> str:
        return (
            f"The recording has {counted(len(self.places), 'gap')} of up to {self.longest:.3g} s "
            f"({listed(self.places)})."
        )

    remedy = "It was cut there. Look for what held up the logger."


@dataclasses.dataclass(frozen=True)
class RepeatedSamples(Finding):
    """:param share: of the samples of a moving channel that repeat the one before"""

    share: float

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' repeats its last value while it moves, in {percent(self.share)} of "
            f"its moving samples ({listed(self.places)})."
        )

    remedy = "The sensor is read more often than it measures: log at its rate, or resample to it."


@dataclasses.dataclass(frozen=True)
class StuckChannel(Finding):
    """:param value: at which the channel stays, in its unit"""

    value: float

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' stays at exactly {self.value:.4g} while other channels move "
            f"({listed(self.places)})."
        )

    remedy = "Check cable and driver of this sensor; leave the channel or these samples out."


@dataclasses.dataclass(frozen=True)
class DeadChannel(StuckChannel):
    """In all recordings: whatever the twin has to predict of it, a wrong cause would do."""

    blocks = True
    remedy = "Check cable and driver of this sensor, or leave the channel out."


@dataclasses.dataclass(frozen=True)
class SaturatedChannel(Finding):
    """
    :param value: that the channel does not exceed, in its unit
    :param share: of the samples that are there
    """

    value: float
    share: float

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' is cut off at {self.value:.4g}: {percent(self.share)} of its "
            f"samples are exactly there ({listed(self.places)})."
        )

    remedy = (
        "Choose a larger range of the sensor, or leave these samples out. A mechanical stop looks "
        "the same: then the twin needs one."
    )


@dataclasses.dataclass(frozen=True)
class Outliers(Finding):
    """
    They outweigh all else in a mean square.

    :param value: farthest one, in the unit of the channel
    :param low: lower end of the range that 98 % of the channel's samples fill
    :param high: upper end
    """

    blocks = True
    value: float
    low: float
    high: float

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' jumps to {self.value:.4g} and back, where 98 % of its samples are "
            f"between {self.low:.4g} and {self.high:.4g} ({listed(self.places)})."
        )

    remedy = "Look at sensor and cable. audit.corrected(data) cuts these samples out."


@dataclasses.dataclass(frozen=True)
class Glitches(Outliers):
    """
    Single samples, far from those around them.

    :param step: largest from one sample to the next elsewhere in these recordings
    """

    step: float

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' jumps to {self.value:.4g} and back in a single sample, where it "
            f"moves by {self.step:.3g} at most from one sample to the next "
            f"({listed(self.places)})."
        )


@dataclasses.dataclass(frozen=True)
class ReinitialisedState(Finding):
    """
    :param to_start: whether the state jumps to where a recording begins
    :param size: of the largest jump, in the unit of its channel
    """

    to_start: bool
    size: float

    @property
    def sentence(self) -> str:
        target = "to where a recording begins" if self.to_start else "as no motion does"
        return (
            f"'{self.channel}' jumps by up to {self.size:.3g} from one sample to the next, "
            f"{target} ({listed(self.places)})."
        )

    remedy = (
        "The system was put back inside the recording: audit.corrected(data) cuts there. Or name "
        "the column that counts episodes when loading."
    )


@dataclasses.dataclass(frozen=True)
class VelocityShift(Finding):
    """
    :param position: name of the channel whose derivative it is
    :param samples: by how many it comes late; negative: early
    :param seconds: the same [s]
    :param stderr: standard error of ``samples``
    """

    position: str
    samples: float
    seconds: float
    stderr: float

    @property
    def sentence(self) -> str:
        verb = "lags" if self.samples > 0 else "leads"
        return (
            f"'{self.channel}' {verb} the derivative of '{self.position}' by "
            f"{abs(self.samples):.2f} +- {self.stderr:.2f} samples, "
            f"{1e3 * abs(self.seconds):.3g} ms ({recordings(self.places)})."
        )

    remedy = (
        "Shift it: audit.corrected(data). A filter in the drive is the usual cause; uncorrected, "
        "it passes for a delay or for friction."
    )


@dataclasses.dataclass(frozen=True)
class BackwardDifference(VelocityShift):
    """A velocity that was computed as one, so that it belongs half a sample earlier."""

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' is the backward difference of '{self.position}', which belongs half "
            f"a sample, {1e3 * self.seconds:.3g} ms, earlier ({recordings(self.places)})."
        )

    remedy = (
        "Shift it: audit.corrected(data). No sensor is late, unless the twin computes its velocity "
        "in the same way."
    )


_UNITS = {"degrees": 57.29578, "millimetres": 1000.0, "centimetres": 100.0}
RPM = 30.0 / 3.1415926536
"""Revolutions per minute of one radian per second."""
_NEAR = 0.15  # what a central difference and noise may change of the factor


@dataclasses.dataclass(frozen=True)
class OtherUnits(Finding):
    """
    A velocity follows the derivative of a position, but for a factor that no sensor is off by.

    :param position: name of the channel whose derivative it is
    :param factor: by which that changes faster than the velocity says
    """

    blocks = True
    position: str
    factor: float

    @property
    def sentence(self) -> str:
        fast = f"changes {self.factor:.3g} times as fast as '{self.channel}' says"
        return (
            f"'{self.position}' {fast} ({recordings(self.places)}): one of them is in other units"
            f"{self._likely}."
        )

    @property
    def _likely(self) -> str:
        for unit, factor in _UNITS.items():
            for name, ratio in ((self.position, factor), (self.channel, 1.0 / factor)):
                if abs(self.factor / ratio - 1.0) < _NEAR:
                    return f", as if '{name}' were in {unit}"
        if abs(self.factor * RPM - 1.0) < _NEAR:
            return f", as if '{self.channel}' were in revolutions per minute"
        return ""

    remedy = (
        "Give that one its unit in columns, as {column: NAME, unit: deg}, or rpm or mm, or its "
        "scale: 0.0174533 if it is in degrees, 0.104720 if it is in revolutions per minute, 0.001 "
        "if it is in millimetres."
    )


@dataclasses.dataclass(frozen=True)
class MistakenUnits(Finding):
    """
    A position that moves as the twin says only if it is in another unit.

    :param column: its name in the log
    :param span: of its measurements
    :param unit: that the twin takes it for
    :param other: the one that fits, in words
    :param symbol: of that
    :param factor: from that to the twin's
    :param explained: share of its acceleration that the twin explains then
    :param times: how often it accelerates as much as the twin says, if it is in the twin's unit
    """

    blocks = True
    column: str
    span: float
    unit: str
    other: str
    symbol: str
    factor: float
    explained: float
    times: float

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' spans {self.span:.3g} {self.unit}, and {self._why} "
            f"({recordings(self.places)}). Write {{column: {self.column}, unit: {self.symbol}}}, "
            f"or scale it by {self.factor:.6g}."
        )

    @property
    def _why(self) -> str:
        return (
            f"the twin explains hardly any of its acceleration, but {percent(self.explained)} if "
            f"it is in {self.other}"
        )

    remedy = "Whatever is named from such data makes up for the factor."


@dataclasses.dataclass(frozen=True)
class LikelyUnits(MistakenUnits):
    """In the other unit, it moves about as much as the twin says, but not when it says so."""

    blocks = False

    @property
    def _why(self) -> str:
        return (
            f"it accelerates {self.times:.2g} times as much as the twin says, as if it were in "
            f"{self.other}"
        )


@dataclasses.dataclass(frozen=True)
class Swapped(Finding):
    """:param derivative_of: name of the channel whose derivative this one is, and not vice versa"""

    blocks = True
    derivative_of: str

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' should be a position and is the derivative of "
            f"'{self.derivative_of}', which should be its velocity ({recordings(self.places)})."
        )

    remedy = "They are swapped: name the columns of obs in the order of the twin's channels."


@dataclasses.dataclass(frozen=True)
class StandingStill(Finding):
    """:param share: of the time during which nothing moves beyond noise"""

    blocks = True
    share: float

    @property
    def sentence(self) -> str:
        return (
            f"The system stands still {percent(self.share)} of the time "
            f"({recordings(self.places)}): this tells the noise of its sensors and nothing about "
            "its motion."
        )

    remedy = "Record motion, with commands that use the range that matters to you."


@dataclasses.dataclass(frozen=True)
class TooShort(Finding):
    """
    :param n_steps: that there are
    :param needed: at least so many
    """

    blocks = True
    n_steps: int
    needed: int

    @property
    def sentence(self) -> str:
        return f"There are {self.n_steps} steps in all; a verdict needs {self.needed} at least."

    remedy = "Record longer, or more often."


@dataclasses.dataclass(frozen=True)
class WeakMotion(Finding):
    """:param ratio: spread of the channel by its noise"""

    ratio: float

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' moves by only {self.ratio:.1f} times its noise "
            f"({recordings(self.places)})."
        )

    remedy = "Move it further: what acts on it cannot be estimated from this."


@dataclasses.dataclass(frozen=True)
class WithinNoise(Finding):
    """:param ratio: largest spread of a channel by its noise"""

    blocks = True
    ratio: float

    @property
    def sentence(self) -> str:
        return (
            f"No channel moves by more than {self.ratio:.1f} times its noise "
            f"({recordings(self.places)})."
        )

    remedy = "Record larger motion: nothing can be estimated from this."


@dataclasses.dataclass(frozen=True)
class MostlyStill(Finding):
    """:param share: of the time during which nothing moves beyond noise"""

    share: float

    @property
    def sentence(self) -> str:
        return (
            f"The system stands still {percent(self.share)} of the time "
            f"({recordings(self.places)})."
        )

    remedy = "Only the rest tells anything about its motion: record more of it."


@dataclasses.dataclass(frozen=True)
class PoorExcitation(Finding):
    """
    :param n_strokes: how often the channel moves one way or the other in all recordings, by a tenth
        of its range at least; no other channel does so more often
    :param n_conditions: under which was recorded
    """

    n_strokes: int
    n_conditions: int

    @property
    def sentence(self) -> str:
        return (
            f"Excitation is poor: no channel goes to and fro more often than '{self.channel}', "
            f"{counted(self.n_strokes, 'stroke')} in {counted(len(self.places), 'recording')} "
            f"under {counted(self.n_conditions, 'condition')} ({recordings(self.places)})."
        )

    remedy = (
        "What takes away less than a fifth of the error hardly stands out from chance in so few. "
        "Record more strokes, at other speeds, and vary what stayed the same: the load, the gain, "
        "the course of the commands."
    )


@dataclasses.dataclass(frozen=True)
class ConstantCommand(Finding):
    """
    :param low: smallest value of the command, in its unit
    :param high: largest one
    """

    low: float
    high: float

    @property
    def sentence(self) -> str:
        span = f"between {self.low:.5g} and {self.high:.5g}"
        value = span if f"{self.low:.4g}" != f"{self.high:.4g}" else f"{self.high:.4g}"
        return f"The command '{self.channel}' is {value} throughout ({recordings(self.places)})."

    remedy = (
        "Gain, delay and lag of this actuator cannot be estimated from this. If it is meant to do "
        "so (free swing), go on."
    )


@dataclasses.dataclass(frozen=True)
class DependentCommand(Finding):
    """:param r2: share of its variance that follows from the observations"""

    r2: float

    @property
    def sentence(self) -> str:
        return (
            f"The command '{self.channel}' follows from the observations of the same moment "
            f"(R2 = {self.r2:.5f}), as under linear feedback ({recordings(self.places)})."
        )

    remedy = (
        "Feedback and dynamics cannot be told apart from this: add a signal to the command, or "
        "change the set point."
    )


@dataclasses.dataclass(frozen=True)
class ReachedLimit(Finding):
    """
    :param value: end of the joint's range
    :param unit: of that
    :param share: of the samples that are there
    """

    value: float
    unit: str
    share: float

    @property
    def sentence(self) -> str:
        return (
            f"Joint '{self.channel}' is at its limit of {self.value:.4g} {self.unit} in "
            f"{percent(self.share)} of the samples ({listed(self.places)})."
        )

    remedy = (
        "The twin has no stops, so what happens there is none of its forces: leave these samples "
        "out, or correct the range in the model file."
    )
