"""Match the columns of a log to the signals of a twin, by names of joints, never by order."""

import dataclasses
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from sb3_hds.core import Trajectories
from sb3_hds.errors import TrajectoryError
from sb3_hds.twins.mujoco.names.renaming import common_affixes, form, likeness, renamed
from sb3_hds.twins.mujoco.names.words import (
    COMMAND,
    EFFORT,
    POSITION,
    VELOCITY,
    Parsed,
    Signal,
    is_current,
    tokens,
)
from sb3_hds.twins.mujoco.twin import MechanismTwin

_COMMANDS = {"position": POSITION, "velocity": VELOCITY, "motor": EFFORT, "dcmotor": EFFORT}
# A column that has at least this share of a joint's words may be that of the joint.
_NEAR = 0.7


@dataclasses.dataclass(frozen=True)
class Matching:
    """
    :param obs: the column of each channel of the twin; None if there is none
    :param actions: the column of each actuator; None if there is none
    :param missing: channels and actuators without a column, each with the nearest unused columns
    :param unused: columns without a channel or actuator
    :param without: joints without any column, if all others have all of theirs
    :param renamed: a sentence on what was taken away from names that differ by it; empty if nothing
    :param locked: the column of the position of each locked joint; None if there is none
    """

    obs: tuple[str | None, ...]
    actions: tuple[str | None, ...]
    missing: tuple[tuple[str, tuple[str, ...]], ...]
    unused: tuple[str, ...]
    without: tuple[str, ...] = ()
    renamed: str = ""
    locked: tuple[str | None, ...] = ()

    def columns(self) -> dict[str, list[dict[str, str]]]:
        """
        :return: ``columns`` for ``Trajectories.load``, without the column of time
        :raises TrajectoryError: if anything is missing
        """
        self.check()
        return {
            "obs": [{"column": str(name)} for name in self.obs],
            "actions": [{"column": str(name)} for name in self.actions],
        }

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on what a user should check."""
        currents = [name for name in self.actions if name and is_current(name)]
        scale = (
            f"By their names, {', '.join(currents)} are motor currents, where the model has "
            "torques. Give the torque constant times the gear ratio [N m/A] as 'scale' in the map "
            "of columns, unless it is in them."
        )
        return tuple(filter(None, [self.renamed, scale if currents else ""]))

    def check(self) -> None:
        """:raises TrajectoryError: if anything is missing, with the nearest names"""
        if self.without:
            raise TrajectoryError(
                f"The log has no columns of {', '.join(self.without)}. If they stand still in the "
                f"data, pass lock={[*self.without]}."
            )
        if self.missing:
            lines = [
                f"  {name}" + (f": perhaps {' or '.join(near)}" if near else "")
                for name, near in self.missing
            ]
            raise TrajectoryError(
                "No column of the log has the name of:\n" + "\n".join(lines) + "\nName columns "
                "yourself in the map of columns, or leave signals out of the twin (observe='q')."
            )


def match(twin: MechanismTwin, names: Iterable[str]) -> Matching:
    """
    :param twin: made from a model file
    :param names: of columns, such as ``"/joint_states:position[elbow_joint]"``, ``"elbow.pos"``,
        ``"dq_elbow"``; a name without a word for the quantity means the position
    """
    parsed = {name: Parsed.of(name) for name in names}
    signals = _signals(twin)
    # Columns of locked joints belong to no other joint.
    locked = [name for name, _ in twin.mechanism.locked]
    every = [*signals, *(signal for name in locked for signal in _of_locked(name))]
    hits, sentence = _matched(every, len(signals), parsed), ""
    if not any(hits[: len(signals)]):
        found = renamed(every, parsed)
        hits, sentence = ([*found.columns], found.sentence) if found else (hits, "")
    standing = tuple(hits[len(signals) :: len(_of_locked(""))])
    hits = hits[: len(signals)]
    unused = tuple(name for name in parsed if name not in hits)
    n = len(twin.channels)
    near = _nearest(signals, {name: parsed[name] for name in unused})
    missing = tuple(
        (signal.name if i < n else f"{signal.name} (command)", near[i])
        for i, signal in enumerate(signals)
        if hits[i] is None
    )
    pairs = list(zip(signals, hits, strict=True))
    seen = {signal.joint for signal, hit in pairs if hit is not None}
    lacking = dict.fromkeys(signal.joint for signal, hit in pairs if hit is None)
    joints = {link.joint for link in twin.mechanism.links}
    without = () if not seen or seen & {*lacking} or {*lacking} - joints else tuple(lacking)
    if not sentence and _another([s for s, _ in pairs], [parsed[name] for name in unused]):
        without = ()
    obs, actions = tuple(hits[:n]), tuple(hits[n:])
    return Matching(obs, actions, missing, unused, without, sentence, standing)


def _of_locked(joint: str) -> tuple[Signal, ...]:
    """What a log may have of a joint that the twin lacks, its position first."""
    kinds = (
        [frozenset([POSITION])],
        [frozenset([VELOCITY])],
        [frozenset([COMMAND, kind]) for kind in (POSITION, EFFORT)] + [frozenset([COMMAND])],
        [frozenset([EFFORT])],
    )
    return tuple(Signal(joint, joint, tuple(own)) for own in kinds)


def _matched(signals: Sequence[Signal], n: int, parsed: Mapping[str, Parsed]) -> list[str | None]:
    """The columns whose names contain those of the joints; the first ``n`` signals agree on it."""
    taken: set[str] = set()

    def found(signal: Signal) -> str | None:
        for kinds in signal.kinds:
            alike = [name for name in parsed if name not in taken and parsed[name].kinds == kinds]
            scores = {name: parsed[name].score(signal.joint) for name in alike}
            best = max(scores.values(), default=0.0)
            first = [name for name, score in scores.items() if score == best > 0.0]
            # Beside a column that is called a position, one without a quantity is none.
            first = [name for name in first if parsed[name].told or len(first) == 1]
            if len(first) == 1:
                taken.add(first[0])
                return first[0]
        return None

    # Longer names first: a column of left_elbow does not belong to elbow.
    order = sorted(range(len(signals)), key=lambda i: -len(tokens(signals[i].joint)))
    hits: dict[int, str | None] = {}
    for i in order:
        hits[i] = found(signals[i])
    # Other words must be the same in all names, like a namespace: right_elbow is not elbow.
    own = {i: name for i, name in hits.items() if name is not None and i < n}
    rest = {i: parsed[name].rest(signals[i].joint) for i, name in own.items()}
    if len(set(rest.values())) > 1:
        hits |= {i: None for i, words in rest.items() if words}
    return [hits[i] for i in range(len(signals))]


def _another(signals: Sequence[Signal], unused: Sequence[Parsed]) -> bool:
    """Whether an unused column may be of a joint that differs by a number: joint8 of joint1."""
    forms = {form(Parsed.of(signal.joint).joint) for signal in signals}
    kinds = {kind for signal in signals for kind in signal.kinds}
    ends = {
        form(column.joint)[i:]
        for column in unused
        if column.kinds in kinds
        for i in range(len(column.joint))
    }
    return bool(forms & ends)


def _nearest(signals: Sequence[Signal], unused: Mapping[str, Parsed]) -> list[tuple[str, ...]]:
    """For each signal, up to two columns of its quantity that may be meant."""
    own = common_affixes({Parsed.of(signal.joint).joint for signal in signals})
    found = []
    for signal in signals:
        words = Parsed.of(signal.joint).joint
        core = words[len(own.before) : len(words) - len(own.after)]
        fitting = [
            name
            for name, x in unused.items()
            if x.kinds in signal.kinds or not (x.told or all(map(str.isdigit, x.joint)))
        ]
        scores = {name: likeness(core, unused[name].joint) for name in fitting}
        best = max(scores.values(), default=0.0)
        near = [name for name in fitting if scores[name] == best >= _NEAR]
        found.append(tuple(near[:2]))
    return found


def arranged(twin: MechanismTwin, data: Trajectories) -> Trajectories:
    """
    :param data: read from a log, with the names of its columns in ``data.report``
    :return: the data with columns in the order of the twin's channels and actuators
    :raises TrajectoryError: if a channel or actuator has no column, with the nearest names, or if
        the data have no names
    """
    report: Any = data.report
    if report is None:
        raise TrajectoryError(
            "These data do not carry the names of their columns, so joints cannot be matched. Read "
            "them from their log: Trajectories.load(files, columns)."
        )
    actions = [f"{name} command" for name in report.actions]
    found = match(twin, [*report.obs, *actions])
    found.check()
    for sentence in found.remarks:
        warnings.warn(sentence, stacklevel=2)
    obs_at = [report.obs.index(str(name)) for name in found.obs]
    actions_at = [actions.index(str(name)) for name in found.actions]
    return dataclasses.replace(
        data,
        obs=np.ascontiguousarray(data.obs[:, :, obs_at]),
        actions=np.ascontiguousarray(data.actions[:, :, actions_at]),
        report=None,
    )


def _signals(twin: MechanismTwin) -> list[Signal]:
    """Channels, then actuators."""
    found = []
    for channel in twin.channels:
        moving = channel.name.endswith(f"_{VELOCITY}")
        joint = channel.name.removesuffix(f"_{VELOCITY}").removesuffix(f"_{POSITION}")
        kind = VELOCITY if moving else POSITION
        found.append(Signal(channel.name, joint, (frozenset([kind]),)))
    names = iter(twin.actuators)
    for drive in twin.mechanism.drives:
        kind = _COMMANDS.get(drive.role, EFFORT)
        kinds = [frozenset([COMMAND, kind]), frozenset([COMMAND])]
        link = twin.mechanism.links[drive.link]
        alone = sum(other.link == drive.link for other in twin.mechanism.drives) == 1
        joint = link.joint if alone and not link.quaternion else drive.name
        for _ in drive.inputs:
            own = next(names).name
            about = joint if len(drive.inputs) == 1 else own
            found.append(Signal(own, about, (*kinds, *_measured(kind))))
    return found


def _measured(kind: str) -> list[frozenset[str]]:
    """A measured effort can replace its command; a measured position cannot replace a target."""
    return [frozenset([EFFORT])] if kind == EFFORT else []
