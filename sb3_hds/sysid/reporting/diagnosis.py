"""The result of a diagnosis."""

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
# With more causes than this, the sentence sums them up by machine, and an ambiguous one does not
# make the verdict ambiguous; with more than the second number, they are listed in a table.
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
    """A result that converts to plain data, such as that of ``measure_policy_gain``."""

    def to_dict(self) -> dict[str, Any]: ...


@dataclasses.dataclass(frozen=True, repr=False)
class Diagnosis:
    """
    Result of :func:`~sb3_hds.sysid.diagnose`. Prints itself.

    :param verdict: ``"named"``, ``"ambiguous"``, ``"none"``, ``"unknown"`` or
        ``"not_identifiable"``; the first two refer to the first finding, and later ones may have
        alternatives in either case
    :param believed: nominal model
    :param twin: extended, ready to train in
    :param data_hash: of the data
    :param seed: of the split and all other random choices
    :param findings: causes, in the order in which they were found
    :param unexplained: residual that they do not explain, in words; empty if there is none
    :param convention: which conventions of the model the log does not follow (``"zero"``,
        ``"direction"``, ``"command"``, ``"degrees"``, ``"order"``, ``"mounting"``, ``"torque"``
        or ``"gear"``, and where: ``"direction.hinge"``), with a ``"+"`` between several, or empty;
        ``unexplained`` says what to write
    :param gain: by horizon in steps
    :param explained: share of the predictable residual force that the findings explain, or 0
    :param detectable: by effect and place, the smallest size that these data would have shown, to
        first order; infinite where a small effect makes no difference, such as a limit that no
        command reaches or a stiff spring in the drive, and for effects without a size (a sign)
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
        """The verdict in one sentence; with several causes, another one on ambiguous ones."""
        doubts = doubts_in_words(self.findings) if self._sums_up else ""
        return f"{self.headline} {doubts}".rstrip()

    @property
    def _sums_up(self) -> bool:
        return self.verdict in ("named", "ambiguous") and len(self.findings) > MANY

    @property
    def tabled(self) -> bool:
        """Whether there are so many causes that they are listed in a table."""
        return len(self.findings) > _TABLE

    @property
    def headline(self) -> str:
        """The verdict in one sentence."""
        if self._sums_up:
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
        """Refitted nuisance parameters: name, nominal value and refitted value."""
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
        """Data, seed and versions, to reproduce the diagnosis."""
        versions = "".join(f", {name} {version}" for name, version in self.versions.items())
        return f"Data {self.data_hash}, seed {self.seed}{versions}."

    @cached_property
    def answers(self) -> Answers:
        """
        The answers that the data leave open, each fitted to all data: the findings; the same with
        each alternative in place of its finding; and, if a residual is unexplained, with each of
        the nearest candidates added. Computed on first access, in seconds.

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
        Update the weights of the :attr:`answers` by new recordings, such as those that
        :meth:`next_experiment` proposes. A new diagnosis of all data would test every candidate
        again and weight recordings equally: one new recording among many old ones hardly changes
        it.

        :param data: recorded since, sampled at the twin's ``dt``
        :return: the answers with weights and parameters given all data, likeliest first;
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
        Design the next recording: smooth commands within the machine's limits that best
        discriminate between the :attr:`answers`, or, with a single answer, that give the most
        information about its parameters.

        The criterion is the worst pair of answers: the distance of one from the predictions of the
        other, with its start states and parameters refitted within what the present data allow.
        Limits hold for every answer, also with parameters two standard deviations off, with a
        margin of a tenth. Commands are those of the twin's actuators: where these are servos, set
        points of the machine's own loop.

        :param limits: what the machine may do, as :class:`~sb3_hds.sysid.design.Limits`, a
            dictionary, or a yml file
        :param n: recordings
        :param seconds: length of each
        :param start: observation at the start of each, shape ``(n_obs,)``; default: the slowest
            start of the recordings
        :param seed: of the search
        :param progress: whether to show a progress bar
        :return: the commands, the prediction of each answer, the probability that they decide, and
            the number of recordings needed; where too many are needed, what would decide instead
        :raises CalibrationError: where no cause was looked for, for an impossible number, length or
            start, or if no commands within the limits were found
        :raises ParameterError: for limits that do not fit the machine
        """
        return next_experiment(
            self.answers, limits, n=n, seconds=seconds, start=start, seed=seed, progress=progress
        )

    def to_dict(self) -> dict[str, Any]:
        """
        :return: plain data for JSON: the twins as their specifications, numbers that are not finite
            as None; ``params`` are the values of the extended twin, without learned arrays
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
        Write one self-contained page: the verdict, its evidence, figures, caveats.

        :param path: of the file, which ends in ``.html``; an existing one is replaced
        :param policy_gain: what ``measure_policy_gain`` returned, where it was measured
        :param experiment: what :meth:`next_experiment` returned, to show its commands and the
            motion that each answer predicts
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

        :param path: of the film, which ends in ``.mp4``; an existing one is replaced
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

        :param folder: is created if it does not exist; existing files are replaced
        :return: their paths
        :raises ImportError: without matplotlib and jinja2 (extra ``report``)
        """
        from sb3_hds.sysid.reporting.page import write_pictures

        return write_pictures(self, folder)

    def __getstate__(self) -> dict[str, Any]:
        """Pickle without the data from which :attr:`answers` would be computed."""
        return self.__dict__ | {"opened": None}

    def __str__(self) -> str:
        return self.summary()

    __repr__ = __str__
