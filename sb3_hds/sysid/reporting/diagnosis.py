"""What a diagnosis says."""

import dataclasses
import os
import textwrap
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, Protocol

from sb3_hds.core import Params, Trajectories, Twin
from sb3_hds.core.belief import BeliefTwin
from sb3_hds.errors import CalibrationError, ParameterError
from sb3_hds.sysid.belief.answers import Answers
from sb3_hds.sysid.belief.belief import belief_of
from sb3_hds.sysid.belief.updated import updated
from sb3_hds.sysid.design.experiment import next_experiment
from sb3_hds.sysid.design.limits import Limits
from sb3_hds.sysid.design.result import NextExperiment
from sb3_hds.sysid.estimation.results import Estimate, plain
from sb3_hds.sysid.reporting import wording
from sb3_hds.sysid.reporting.pictures import Pictures
from sb3_hds.sysid.reporting.sentence import several_in_words, spoken
from sb3_hds.sysid.reporting.units import sizes_in_words, with_unit

Verdict = Literal["named", "ambiguous", "none", "unknown", "not_identifiable"]

_WIDTH = 80
# Causes beyond which they are told as those of a machine, and one that the data cannot tell from
# others leaves the others named; and beyond which they are in a table.
MANY, _TABLE = 2, 3
# Candidates whose smallest sizes are printed; all are in the report.
_MOST_SHOWN = 12
# Rejected candidates that get a line of their own.
_MOST_IN_TABLE = 5
#: what each verdict means
SENTENCES = {
    "named": "The data name what is missing.",
    "ambiguous": "Something is missing, and the data cannot tell which of several causes it is.",
    "none": "The data show nothing that the simulation gets wrong.",
    "unknown": "Something is there that none of the candidates explains.",
    "not_identifiable": "These data cannot support a verdict.",
}
OTHER_CONVENTION = "The log is not written in the conventions of the model."


class _Plain(Protocol):
    """What can be told as plain data, as what ``measure_policy_gain`` returns."""

    def to_dict(self) -> dict[str, Any]: ...


@dataclasses.dataclass(frozen=True)
class Finding:
    """
    One cause.

    :param effect: name in the catalogue, or ``"parameter.NAME"``
    :param where: ``slot``, ``index`` and ``name`` of its place
    :param parameters: estimates with intervals and units, by short name
    :param alternatives: what the data cannot tell from it, by name and place
    :param p_value: that held-out recordings would gain as much by chance, by the test that
        confirmed it; where others were asked about before it, it had to pass a stricter level
    :param family_p_value: that the best of all candidates would gain as much on the recordings that
        proposed it if nothing were wrong
    :param gain: share by which it lowers the mean square error of held-out recordings
    :param explanation: one sentence for people
    :param share: of the force at its joint that it carries, root mean squares; None where that was
        not computed
    """

    effect: str
    where: Mapping[str, Any]
    parameters: Mapping[str, Estimate]
    alternatives: tuple[str, ...]
    p_value: float
    family_p_value: float
    gain: float
    explanation: str
    share: float | None = None

    @property
    def key(self) -> str:
        """Name and place, as in ``rejected`` and ``detectable``."""
        own = self.where["slot"] == "parameter"
        return self.effect if own else f"{self.effect}.{self.where['name']}"


@dataclasses.dataclass(frozen=True)
class Rejected:
    """
    A candidate that was not accepted.

    :param name: effect and place
    :param gain: share by which it lowers the mean square error of held-out recordings, after what
        was accepted
    :param p_value: that they would gain as much by chance
    :param why: in words
    """

    name: str
    gain: float
    p_value: float
    why: str


@dataclasses.dataclass(frozen=True)
class HorizonGain:
    """
    Error of predictions so many steps ahead, on held-out recordings, over all channels, in units of
    their noise.

    :param steps: ahead
    :param before: root mean square error of the twin as it came, nuisances refitted
    :param after: of the extended one
    :param low: lower end of the 90 % interval of the relative gain
    :param high: upper end
    """

    steps: int
    before: float
    after: float
    low: float
    high: float


@dataclasses.dataclass(frozen=True, repr=False)
class Diagnosis:
    """
    Result of :func:`~sb3_hds.sysid.diagnose`. Prints itself.

    :param verdict: ``"named"``, ``"ambiguous"``, ``"none"``, ``"unknown"`` or
        ``"not_identifiable"``; the first two are about the first finding, and a later one may have
        alternatives all the same
    :param believed: the twin as it came
    :param twin: extended, ready to train in
    :param data_hash: of the data
    :param seed: of the split and of what else was drawn
    :param findings: causes, in the order in which they were found
    :param unexplained: what remains after them, in words; empty if nothing does
    :param convention: which convention of the model the log does not follow (``"zero"``,
        ``"direction"``, ``"command"``, ``"degrees"`` or ``"order"``, and where:
        ``"direction.hinge"``), or empty; ``unexplained`` says what to write
    :param gain: by horizon in steps
    :param explained: share that the findings explain of the force that is missing and can be
        predicted, or 0
    :param detectable: by effect and place, the smallest size that these data would have shown, to
        first order; infinite where the first bit of an effect makes no difference, as of a limit
        that no command reaches, of a stiff spring in the drive, or of what has no size (a sign)
    :param rejected: the other candidates, with numbers
    :param caveats: what to keep in mind, in words
    :param versions: of the libraries that computed this
    :param pictures: numbers ready to draw; not part of :meth:`to_dict`
    :param opened: computes :attr:`answers`; not part of :meth:`to_dict`
    """

    verdict: Verdict
    believed: Twin
    twin: Twin
    data_hash: str
    seed: int
    findings: tuple[Finding, ...] = ()
    unexplained: str = ""
    convention: str = ""
    gain: Mapping[int, HorizonGain] = dataclasses.field(default_factory=dict)
    explained: float = 0.0
    detectable: Mapping[str, Mapping[str, float]] = dataclasses.field(default_factory=dict)
    rejected: tuple[Rejected, ...] = ()
    caveats: tuple[str, ...] = ()
    versions: Mapping[str, str] = dataclasses.field(
        default_factory=lambda: {name: version(name) for name in ("sb3-hds", "jax", "numpy")}
    )
    pictures: Pictures | None = None
    opened: Callable[[], Answers] | None = dataclasses.field(default=None, compare=False)

    @property
    def params(self) -> Params:
        """All parameters of the extended twin."""
        return self.twin.params

    @property
    def sentence(self) -> str:
        """The verdict in one sentence."""
        if self.verdict in ("named", "ambiguous") and len(self.findings) > MANY:
            return several_in_words(self.findings, [j.name for j in self.believed.joints])
        if self.verdict == "ambiguous":
            first, *others = self.findings
            choice = " or ".join(map(spoken, (first.key, *first.alternatives)))
            also = f", and {' and '.join(map(_choice, others))}" if others else ""
            return f"The simulation is wrong about {choice}{also}: the data cannot tell which."
        if self.convention:
            return OTHER_CONVENTION
        if self.verdict != "named":
            return SENTENCES[self.verdict]
        new = [f for f in self.findings if self._is_new(f)]
        said = {"lacks": new, "is wrong about": [f for f in self.findings if f not in new]}
        parts = [
            f"{verb} {' and '.join(map(_choice, found))}" for verb, found in said.items() if found
        ]
        return f"The simulation {' and '.join(parts)}."

    def _is_new(self, finding: Finding) -> bool:
        """Whether the believed twin has nothing of the kind."""
        names = {e.name for e in finding.parameters.values()}
        return names <= {*self.twin.values} - {*self.believed.values}

    def summary(self) -> str:
        """:return: all of it in 80 columns"""
        lines = [*_wrapped(f"{self.verdict}: {self.sentence}"), "=" * _WIDTH]
        if len(self.findings) > _TABLE:
            lines += _table_of(self.findings)
        else:
            for finding in self.findings:
                lines += _of_finding(finding)
        if self.findings:
            lines += _wrapped(wording.explained_in_words(self.explained))
        if self.verdict == "none":
            lines += self._would_have_shown()
        if self.unexplained:
            lines += _wrapped(f"Unexplained: {self.unexplained}")
        if self.refitted:
            changes = ", ".join(f"{name} {a} -> {b}" for name, a, b in self.refitted)
            lines += _wrapped(f"Refitted: {changes}")
        if self.gain:
            lines.append(f"{wording.HORIZONS}:")
            lines += [
                f"  {g.steps:5d}: {g.before:9.3g} -> {g.after:9.3g}   "
                f"(90 % interval of the gain {g.low:.0%} to {g.high:.0%})"
                for g in self.gain.values()
            ]
        lines += self._not_accepted()
        for caveat in self.caveats:
            lines += _wrapped(f"Caveat: {caveat}")
        text = "\n".join([*lines, *_wrapped(self.made_with)])
        return text.replace("\N{NO-BREAK SPACE}", " ")

    @property
    def refitted(self) -> tuple[tuple[str, str, str], ...]:
        """What was calibrated on the way: name, value as believed, and value in the end."""
        known = self.believed.values
        found = {e.name for finding in self.findings for e in finding.parameters.values()}
        return tuple(
            (name, f"{known[name]:.4g}", with_unit(f"{value:.4g}", self.twin.parameters[name].unit))
            for name, value in self.twin.values.items()
            if name in known and name not in found and value != known[name]
        )

    @property
    def made_with(self) -> str:
        """What a diagnosis is computed again from."""
        versions = "".join(f", {name} {version}" for name, version in self.versions.items())
        return f"Data {self.data_hash}, seed {self.seed}{versions}."

    def _not_accepted(self) -> list[str]:
        """The best as a table, and all others by the reason."""
        if not self.rejected:
            return []
        best, others = self.rejected[:_MOST_IN_TABLE], self.rejected[_MOST_IN_TABLE:]
        width = max(len(r.name) for r in best)
        lines = [f"{'Not accepted':<{width + 2}} {'gain':>9} {'p':>7}  why"]
        for r in best:
            gain, chance = wording.share_in_words(r.gain), wording.chance_in_words(r.p_value)
            row = f"  {r.name:<{width}} {gain:>9} {chance:>7}  {r.why}"
            lines += (
                [row] if len(row) <= _WIDTH else [row.removesuffix(f"  {r.why}"), f"    {r.why}"]
            )
        for why in dict.fromkeys(r.why for r in others):
            names = [
                r.name
                if why == wording.TOO_LITTLE
                else f"{r.name} {wording.share_in_words(r.gain)}"
                for r in others
                if r.why == why
            ]
            lines += _wrapped(f"{why}: {', '.join(map(str.strip, names))}", "  ")
        return [*lines, *_wrapped(f"({wording.REJECTED})", "  ")]

    def _would_have_shown(self) -> list[str]:
        shown = [
            f"  {key}: {words}"
            for key, sizes in self.detectable.items()
            if (words := sizes_in_words(self.twin, key, sizes))
        ]
        lines = ["They would have shown, if it were no smaller than:"] if shown else []
        lines += [line for each in shown[:_MOST_SHOWN] for line in _wrapped(each)]
        more = len(shown) - _MOST_SHOWN
        return (
            [*lines, f"  and {more} more, in the report and in `detectable`"] if more > 0 else lines
        )

    @cached_property
    def answers(self) -> Answers:
        """
        The answers that the data leave open, each fitted to all of them: the findings, every
        alternative in the place of its finding, and where something has no name, the candidates
        that come nearest. Computed when it is first asked for, in seconds.

        :raises CalibrationError: where no cause was looked for
        """
        if self.opened is None:
            raise CalibrationError(
                f"There are no answers to choose between: {self.sentence} "
                f"{self.unexplained}".strip()
            )
        return self.opened()

    def decided_by(self, data: Trajectories) -> Answers:
        """
        Weigh the :attr:`answers` by recordings made since, such as those that
        :meth:`next_experiment` asked for. A diagnosis of all data together asks every candidate
        again, and counts recordings: one new one among many old ones hardly moves it.

        :param data: recorded since, sampled at the twin's ``dt``
        :return: the answers with weights and parameters as all data have them, likeliest first;
            ``settled`` where one has 95 % of the weight
        :raises CalibrationError: where no cause was looked for, or for other channels or another
            interval than the twin's
        :raises TrajectoryError: if no recording is long enough
        """
        return updated(self.answers, data)

    @cached_property
    def belief(self) -> BeliefTwin:
        """
        The answers with their weights and uncertain parameters as one twin of 64 equally likely
        draws, to train in; see :func:`~sb3_hds.sysid.belief.belief.belief_of` for another number.

        :raises CalibrationError: where no cause was looked for
        """
        return belief_of(self.answers, seed=self.seed)

    def next_experiment(
        self,
        limits: "Limits | Mapping[str, Any] | str | os.PathLike[str]",
        *,
        n: int = 1,
        seconds: float = 10.0,
        start: Any = None,
        seed: int = 0,
        progress: bool = True,
    ) -> NextExperiment:
        r"""
        What to record next: smooth commands within the machine's limits that decide between the
        :attr:`answers`; of a single answer, that tell most about its parameters.

        The worst pair of answers counts: for each, how far one is from predicting what the other
        does, its start states and parameters refitted within what the present data allow. Limits
        hold for every answer, also with parameters two standard deviations off, with a tenth to
        spare. Commands are those of the twin's actuators: where these are servos, set points of
        the machine's own loop.

        :param limits: what the machine may do, as :class:`~sb3_hds.sysid.design.Limits`, a
            dictionary, or a yml file
        :param n: recordings
        :param seconds: length of each
        :param start: observation at the start of each, shape ``(n_obs,)``; default: that of the
            recording which began slowest
        :param seed: of the search
        :param progress: whether a bar shows how far it is
        :return: the commands, what each answer predicts, how surely they would decide, and how
            often they would have to be recorded; where that is no way to decide, what would be
        :raises CalibrationError: where no cause was looked for, for an impossible number, length or
            start, or if no commands within the limits were found
        :raises ParameterError: for limits that do not fit the machine
        """
        return next_experiment(
            self.answers, limits, n=n, seconds=seconds, start=start, seed=seed, progress=progress
        )

    def to_dict(self) -> dict[str, Any]:
        """
        :return: the same, as plain data for JSON: the twins as their specifications, numbers that
            are not finite as None; ``params`` are the numbers of the extended twin, and arrays that
            were learned are left out
        """
        found = {
            field.name: getattr(self, field.name)
            for field in dataclasses.fields(self)
            if field.name not in ("believed", "twin", "pictures", "opened")
        }
        twins = {"believed": self.believed.to_spec(), "twin": self.twin.to_spec()}
        said = {"sentence": self.sentence, "params": self.twin.values}
        return plain(found | twins | said)

    def to_html(
        self,
        path: str | os.PathLike[str],
        policy_gain: "Mapping[str, Any] | _Plain | None" = None,
        experiment: NextExperiment | None = None,
    ) -> Path:
        """
        Write one self-contained page: the verdict, its evidence, pictures, caveats.

        :param path: of the file, which ends in ``.html``; one of that name is replaced as a whole
        :param policy_gain: what ``measure_policy_gain`` returned, where it was measured
        :param experiment: what :meth:`next_experiment` returned, to be shown with its commands and
            the motion that each answer predicts
        :return: its path
        :raises ImportError: without matplotlib and jinja2 (extra ``report``)
        :raises ParameterError: for another ending
        :raises OSError: if there is no folder to write it in
        """
        from sb3_hds.sysid.reporting.page import write_report

        plain = policy_gain if isinstance(policy_gain, Mapping | None) else policy_gain.to_dict()
        return write_report(self, path, plain, experiment)

    def to_film(self, path: str | os.PathLike[str]) -> Path:
        """
        Write the machine's motion over a held-out recording, measured and as both twins predict it.

        :param path: of the film, which ends in ``.mp4``; a file of that name is replaced as a whole
        :return: its path
        :raises ImportError: without imageio-ffmpeg and matplotlib
        :raises ParameterError: for another ending, or where nothing was simulated
        :raises OSError: if there is no folder to write it in
        """
        from sb3_hds.sysid.reporting.film import write_film
        from sb3_hds.sysid.reporting.moving import moving_of

        if self.pictures is None:
            raise ParameterError(f"Nothing was simulated, so nothing moves: {self.sentence}")
        return write_film(moving_of(self.believed, self.twin, self.pictures.replay), path)

    def save_pictures(self, folder: str | os.PathLike[str]) -> list[Path]:
        """
        Write the pictures of the report as PNG files, for a page or a paper.

        :param folder: is made where it is missing; files of the same names are replaced
        :return: their paths
        :raises ImportError: without matplotlib and jinja2 (extra ``report``)
        """
        from sb3_hds.sysid.reporting.page import write_pictures

        return write_pictures(self, folder)

    def __getstate__(self) -> dict[str, Any]:
        """What was asked for stays; the data that further answers would need do not."""
        return self.__dict__ | {"opened": None}

    def __str__(self) -> str:
        return self.summary()

    __repr__ = __str__


def _table_of(findings: Sequence[Finding]) -> list[str]:
    """Many causes, one line for each size."""
    rows = []
    for finding in findings:
        name = spoken(finding.key).replace(f" at {finding.where['name']}", "")
        own = finding.where["slot"] == "parameter"
        place = "" if own else finding.where["name"]
        share = "" if finding.share is None else f"{finding.share:.0%}"
        for e in finding.parameters.values():
            rows.append(
                (place, name, wording.size_in_words(e), wording.interval_in_words(e), share)
            )
    head = ("joint", "cause", "size", "90 % interval", "of force")
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]
    lines = [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in [head, *rows]
    ]
    alike = [
        f"{spoken(f.key)}: the data cannot tell it from {' or '.join(map(spoken, f.alternatives))}."
        for f in findings
        if f.alternatives
    ]
    return [*lines, *(line for text in alike for line in _wrapped(text))]


def _of_finding(finding: Finding) -> list[str]:
    own, place = finding.where["slot"] == "parameter", finding.where["name"]
    lines = [finding.effect if own else f"{finding.effect} at {finding.where['slot']} {place}"]
    lines += _wrapped(finding.explanation, "  ")
    for name, e in finding.parameters.items():
        said = f"{name} = {wording.size_in_words(e)}, standard error {e.stderr:.2g}, 90 % interval "
        lines += _wrapped(f"{said}{wording.interval_in_words(e)}", "  ")
    lines += _wrapped(wording.evidence_in_words(finding.gain, finding.p_value), "  ")
    if finding.alternatives:
        lines += _wrapped(f"{wording.ALIKE} {', '.join(finding.alternatives)}.", "  ")
    return lines


def _choice(finding: Finding) -> str:
    """With what cannot be told from it."""
    names = [spoken(key) for key in (finding.key, *finding.alternatives)]
    return names[0] if len(names) == 1 else f"either {' or '.join(names)}"


def _wrapped(text: str, indent: str = "") -> list[str]:
    # A name that is longer than a line stays whole.
    return textwrap.wrap(
        text,
        _WIDTH,
        initial_indent=indent,
        subsequent_indent=indent + "  ",
        break_long_words=False,
        break_on_hyphens=False,
    )
