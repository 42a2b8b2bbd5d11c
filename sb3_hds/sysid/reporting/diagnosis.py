"""What a diagnosis says."""

import dataclasses
import os
from collections.abc import Callable, Mapping
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
from sb3_hds.sysid.estimation.results import plain
from sb3_hds.sysid.reporting import wording
from sb3_hds.sysid.reporting.finding import Finding, HorizonGain, Rejected
from sb3_hds.sysid.reporting.pictures import Pictures
from sb3_hds.sysid.reporting.printed import (
    WIDTH,
    choice,
    doubts_in_words,
    finding_in_lines,
    not_accepted,
    several_in_words,
    spoken,
    table_of,
    would_have_shown,
    wrapped,
)
from sb3_hds.sysid.reporting.wording import with_unit

Verdict = Literal["named", "ambiguous", "none", "unknown", "not_identifiable"]
# Causes beyond which they are told as those of a machine, and one that the data cannot tell from
# others leaves the others named; and beyond which they are in a table.
MANY, _TABLE = 2, 3

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


@dataclasses.dataclass(frozen=True, repr=False)
class Diagnosis:
    """
    Result of :func:`~sb3_hds.sysid.diagnose`. Prints itself.

    :param verdict: ``"named"``, ``"ambiguous"``, ``"none"``, ``"unknown"`` or
        ``"not_identifiable"``; the first two are about the first finding, and a later one may have
        alternatives all the same
    :param believed: nominal model
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
        """The verdict in one sentence; of several causes, with one on what stays open."""
        doubts = doubts_in_words(self.findings) if self._tells_several else ""
        return f"{self.headline} {doubts}".rstrip()

    @property
    def _tells_several(self) -> bool:
        return self.verdict in ("named", "ambiguous") and len(self.findings) > MANY

    @property
    def tabled(self) -> bool:
        """Whether the causes are so many that they are told in a table."""
        return len(self.findings) > _TABLE

    @property
    def headline(self) -> str:
        """The verdict in one sentence."""
        if self._tells_several:
            return several_in_words(self.findings, [j.name for j in self.believed.joints])
        if self.verdict == "ambiguous":
            first, *others = self.findings
            named = " or ".join(map(spoken, (first.key, *first.alternatives)))
            also = f", and {' and '.join(map(choice, others))}" if others else ""
            return f"The simulation is wrong about {named}{also}: the data cannot tell which."
        if self.convention:
            return OTHER_CONVENTION
        if self.verdict != "named":
            return SENTENCES[self.verdict]
        added = {*self.twin.values} - {*self.believed.values}
        new = [f for f in self.findings if {e.name for e in f.parameters.values()} <= added]
        said = {"lacks": new, "is wrong about": [f for f in self.findings if f not in new]}
        parts = [
            f"{verb} {' and '.join(map(choice, found))}" for verb, found in said.items() if found
        ]
        return f"The simulation {' and '.join(parts)}."

    def summary(self) -> str:
        """:return: all of it in 80 columns"""
        lines = [*wrapped(f"{self.verdict}: {self.headline}"), "=" * WIDTH]
        if self.tabled:
            lines += table_of(self.findings, [joint.name for joint in self.believed.joints])
        else:
            for finding in self.findings:
                lines += finding_in_lines(finding)
        if self.findings:
            lines += wrapped(wording.explained_in_words(self.explained))
        if self.verdict == "none":
            lines += would_have_shown(self.twin, self.detectable)
        if self.unexplained:
            lines += wrapped(f"Unexplained: {self.unexplained}")
        if self.refitted:
            changes = ", ".join(f"{name} {a} -> {b}" for name, a, b in self.refitted)
            lines += wrapped(f"Refitted: {changes}")
        if self.gain:
            lines.append(f"{wording.HORIZONS}:")
            lines += [
                f"  {g.steps:5d}: {g.before:9.3g} -> {g.after:9.3g}   "
                f"(90 % interval of the gain {g.low:.0%} to {g.high:.0%})"
                for g in self.gain.values()
            ]
        lines += not_accepted(self.rejected)
        for caveat in self.caveats:
            lines += wrapped(f"Caveat: {caveat}")
        text = "\n".join([*lines, *wrapped(self.made_with)])
        return text.replace("\N{NO-BREAK SPACE}", " ")

    @property
    def refitted(self) -> tuple[tuple[str, str, str], ...]:
        """What was calibrated on the way: name, value as believed, and value in the end."""
        known = self.believed.values
        found = {e.name for finding in self.findings for e in finding.parameters.values()}
        for finding in self.findings:
            place = finding.effect, finding.where["index"]
            found |= {*self.believed.native_effects.get(place, {}).values()}
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
        left_out = {"believed", "twin", "pictures", "opened"}
        names = [f.name for f in dataclasses.fields(self) if f.name not in left_out]
        found = {name: getattr(self, name) for name in names}
        twins = {"believed": self.believed.to_spec(), "twin": self.twin.to_spec()}
        return plain(found | twins | {"sentence": self.sentence, "params": self.twin.values})

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
        Write the machine's motion over held-out stretches, measured and as both twins predict it.

        :param path: of the film, which ends in ``.mp4``; a file of that name is replaced as a whole
        :return: its path
        :raises ImportError: without imageio-ffmpeg and matplotlib
        :raises ParameterError: for another ending, or where nothing was simulated
        :raises OSError: if there is no folder to write it in
        """
        from sb3_hds.sysid.reporting.animation import animate
        from sb3_hds.sysid.reporting.film import write_film

        if self.pictures is None:
            raise ParameterError(f"Nothing was simulated, so nothing moves: {self.sentence}")
        return write_film(animate(self.believed, self.twin, self.pictures.replay), path)

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
