"""Match the columns of a log to the signals of a twin: by names of joints, never by their order."""

import dataclasses
import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from typing import Any

import numpy as np

from sb3_hds.core import Trajectories
from sb3_hds.errors import TrajectoryError
from sb3_hds.twins.mujoco.twin import MechanismTwin

_POSITION, _VELOCITY, _EFFORT, _COMMAND = "position", "velocity", "effort", "command"
# What logs call them, in ROS, LeRobot and elsewhere.
_WORDS = {
    _POSITION: ("position", "positions", "pos", "qpos", "q", "angle", "angles"),
    _VELOCITY: ("velocity", "velocities", "vel", "qvel", "qd", "dq", "speed", "rate"),
    _EFFORT: ("effort", "efforts", "torque", "torques", "tau", "force", "current"),
    _COMMAND: (
        *("command", "commands", "cmd", "target", "targets", "goal", "action", "setpoint"),
        *("desired", "des", "reference", "ref", "control", "ctrl"),
    ),
}
_KIND_OF = {word: kind for kind, words in _WORDS.items() for word in words}
# Words that tell no joint from another.
_IDLE = {"joint", "joints", "state", "states", "observation", "obs"}
_COMMANDS = {"position": _POSITION, "velocity": _VELOCITY, "motor": _EFFORT, "dcmotor": _EFFORT}


@dataclasses.dataclass(frozen=True)
class Matching:
    """
    :param obs: for each channel of the twin, the column that holds it; None if there is none
    :param actions: likewise for each actuator
    :param missing: channels and actuators without a column, each with the nearest unused columns
    :param unused: columns that belong to none
    """

    obs: tuple[str | None, ...]
    actions: tuple[str | None, ...]
    missing: tuple[tuple[str, tuple[str, ...]], ...]
    unused: tuple[str, ...]

    def columns(self) -> dict[str, list[dict[str, str]]]:
        """
        :return: what ``Trajectories.load(files, columns)`` takes, but for the column of time
        :raises TrajectoryError: if anything is missing
        """
        self.check()
        return {
            "obs": [{"column": str(name)} for name in self.obs],
            "actions": [{"column": str(name)} for name in self.actions],
        }

    def check(self) -> None:
        """:raises TrajectoryError: if anything is missing, with the nearest names"""
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
    :param names: of columns, as ``"/joint_states:position[elbow_joint]"``, ``"elbow.pos"``,
        ``"dq_elbow"``; where no word says what of a joint it is, its position
    """
    columns = list(dict.fromkeys(names))
    parsed = {name: _Parsed.by(name) for name in columns}
    taken: set[str] = set()

    def found(joint: str, kinds: Sequence[frozenset[str]]) -> str | None:
        for kind in kinds:
            alike = [name for name in columns if name not in taken and parsed[name].kinds == kind]
            scores = {name: parsed[name].fits(joint) for name in alike}
            best = max(scores.values(), default=0.0)
            first = [name for name, score in scores.items() if score == best > 0.0]
            if len(first) == 1:
                taken.add(first[0])
                return first[0]
        return None

    signals = _signals(twin)
    # Longer names first: what belongs to left_elbow is not that of elbow.
    order = sorted(range(len(signals)), key=lambda i: -len(_tokens(signals[i][1])))
    hits: dict[int, str | None] = {}
    for i in order:
        _, joint, kinds = signals[i]
        hits[i] = found(joint, kinds)
    # What else a name says must be a prefix of all, as of a namespace: right_elbow is no elbow.
    beside = {i: parsed[name].beside(signals[i][1]) for i, name in hits.items() if name is not None}
    if len(set(beside.values())) > 1:
        hits |= {i: None for i, more in beside.items() if more}
        taken = {name for name in hits.values() if name is not None}
    unused = tuple(name for name in columns if name not in taken)
    n = len(twin.channels)
    missing = tuple(
        (name if i < n else f"{name} (command)", tuple(get_close_matches(name, unused, 2, 0.4)))
        for i, (name, _, _) in enumerate(signals)
        if hits[i] is None
    )
    both = [hits[i] for i in range(len(signals))]
    return Matching(tuple(both[:n]), tuple(both[n:]), missing, unused)


def arranged(twin: MechanismTwin, data: Trajectories) -> Trajectories:
    """
    :param data: read from a log, with the names of its columns in ``data.report``
    :return: its columns in the order of the twin's channels and actuators
    :raises TrajectoryError: if a channel or actuator has no column, with the nearest names, or if
        the data do not carry names
    """
    report: Any = data.report
    if report is None:
        raise TrajectoryError(
            "These data do not carry the names of their columns, so joints cannot be matched by "
            "name. Read them from their log: Trajectories.load(files, columns)."
        )
    found = match(twin, [*report.obs, *(f"{name} command" for name in report.actions)])
    found.check()
    actions = [f"{name} command" for name in report.actions]
    obs_at = [report.obs.index(str(name)) for name in found.obs]
    actions_at = [actions.index(str(name)) for name in found.actions]
    return dataclasses.replace(
        data,
        obs=np.ascontiguousarray(data.obs[:, :, obs_at]),
        actions=np.ascontiguousarray(data.actions[:, :, actions_at]),
        report=None,
    )


@dataclasses.dataclass(frozen=True)
class _Parsed:
    """The parsed name of a column."""

    joint: tuple[str, ...]
    kinds: frozenset[str]

    @classmethod
    def by(cls, name: str) -> "_Parsed":
        words = _tokens(name)
        kinds = frozenset(_KIND_OF[word] for word in words if word in _KIND_OF)
        joint = tuple(word for word in words if word not in _KIND_OF and word not in _IDLE)
        return cls(joint, kinds or frozenset([_POSITION]))

    def beside(self, joint: str) -> tuple[str, ...]:
        """:return: words that are not those of the joint"""
        own = _Parsed.by(joint).joint
        return tuple(word for word in self.joint if word not in own)

    def fits(self, joint: str) -> float:
        """:return: 0 if it is of another joint; more, the less else is said"""
        wanted = _Parsed.by(joint).joint
        n = len(wanted)
        if not n or not self.joint:
            return float(self.joint == wanted)
        inside = any(self.joint[i : i + n] == wanted for i in range(len(self.joint) - n + 1))
        return n / len(self.joint) if inside else 0.0


def _signals(twin: MechanismTwin) -> list[tuple[str, str, list[frozenset[str]]]]:
    """Channels, then actuators: name, joint, and what a column may say that it holds."""
    found: list[tuple[str, str, list[frozenset[str]]]] = []
    for channel in twin.channels:
        moving = channel.name.endswith(f"_{_VELOCITY}")
        joint = channel.name.removesuffix(f"_{_VELOCITY}").removesuffix(f"_{_POSITION}")
        found.append((channel.name, joint, [frozenset([_VELOCITY if moving else _POSITION])]))
    names = iter(twin.actuators)
    for drive in twin.mechanism.drives:
        kind = _COMMANDS.get(drive.role, _EFFORT)
        kinds = [frozenset([_COMMAND, kind]), frozenset([_COMMAND])]
        link = twin.mechanism.links[drive.link]
        alone = sum(other.link == drive.link for other in twin.mechanism.drives) == 1
        joint = link.joint if alone and not link.quaternion else drive.name
        for _ in drive.inputs:
            own = next(names).name
            found.append(
                (own, joint if len(drive.inputs) == 1 else own, [*kinds, *_measured(kind)])
            )
    return found


def _measured(kind: str) -> list[frozenset[str]]:
    """A measured effort can replace its command; a measured position is no target."""
    return [frozenset([_EFFORT])] if kind == _EFFORT else []


def _tokens(name: str) -> list[str]:
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name)]
