"""Match the columns of a log to the signals of a twin, by names of joints, never by order."""

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
# Their names in logs of ROS, LeRobot and others.
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
# Words that do not distinguish joints.
_IGNORED = {"joint", "joints", "state", "states", "observation", "obs"}
_COMMANDS = {"position": _POSITION, "velocity": _VELOCITY, "motor": _EFFORT, "dcmotor": _EFFORT}


@dataclasses.dataclass(frozen=True)
class Matching:
    """
    :param obs: the column of each channel of the twin; None if there is none
    :param actions: the column of each actuator; None if there is none
    :param missing: channels and actuators without a column, each with the nearest unused columns
    :param unused: columns without a channel or actuator
    """

    obs: tuple[str | None, ...]
    actions: tuple[str | None, ...]
    missing: tuple[tuple[str, tuple[str, ...]], ...]
    unused: tuple[str, ...]

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
    :param names: of columns, such as ``"/joint_states:position[elbow_joint]"``, ``"elbow.pos"``,
        ``"dq_elbow"``; a name without a word for the quantity means the position
    """
    columns = list(dict.fromkeys(names))
    parsed = {name: _Parsed.of(name) for name in columns}
    taken: set[str] = set()

    def found(joint: str, kinds: Sequence[frozenset[str]]) -> str | None:
        for kind in kinds:
            alike = [name for name in columns if name not in taken and parsed[name].kinds == kind]
            scores = {name: parsed[name].score(joint) for name in alike}
            best = max(scores.values(), default=0.0)
            first = [name for name, score in scores.items() if score == best > 0.0]
            if len(first) == 1:
                taken.add(first[0])
                return first[0]
        return None

    signals = _signals(twin)
    # Longer names first: a column of left_elbow does not belong to elbow.
    order = sorted(range(len(signals)), key=lambda i: -len(_tokens(signals[i][1])))
    hits: dict[int, str | None] = {}
    for i in order:
        _, joint, kinds = signals[i]
        hits[i] = found(joint, kinds)
    # Other words must be the same in all names, like a namespace: right_elbow is not elbow.
    rest = {i: parsed[name].rest(signals[i][1]) for i, name in hits.items() if name is not None}
    if len(set(rest.values())) > 1:
        hits |= {i: None for i, words in rest.items() if words}
        taken = {name for name in hits.values() if name is not None}
    unused = tuple(name for name in columns if name not in taken)
    n = len(twin.channels)
    missing = tuple(
        (name if i < n else f"{name} (command)", tuple(get_close_matches(name, unused, 2, 0.4)))
        for i, (name, _, _) in enumerate(signals)
        if hits[i] is None
    )
    matched = [hits[i] for i in range(len(signals))]
    return Matching(tuple(matched[:n]), tuple(matched[n:]), missing, unused)


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
    """The words of a column's name."""

    joint: tuple[str, ...]
    kinds: frozenset[str]

    @classmethod
    def of(cls, name: str) -> "_Parsed":
        words = _tokens(name)
        kinds = frozenset(_KIND_OF[word] for word in words if word in _KIND_OF)
        joint = tuple(word for word in words if word not in _KIND_OF and word not in _IGNORED)
        return cls(joint, kinds or frozenset([_POSITION]))

    def rest(self, joint: str) -> tuple[str, ...]:
        """:return: words that are not in the name of the joint"""
        own = _Parsed.of(joint).joint
        return tuple(word for word in self.joint if word not in own)

    def score(self, joint: str) -> float:
        """:return: 0 for another joint, otherwise the share of the joint's words in the name"""
        wanted = _Parsed.of(joint).joint
        n = len(wanted)
        if not n or not self.joint:
            return float(self.joint == wanted)
        inside = any(self.joint[i : i + n] == wanted for i in range(len(self.joint) - n + 1))
        return n / len(self.joint) if inside else 0.0


def _signals(twin: MechanismTwin) -> list[tuple[str, str, list[frozenset[str]]]]:
    """Channels, then actuators: name, joint, and the quantities that a column may have."""
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
    """A measured effort can replace its command; a measured position cannot replace a target."""
    return [frozenset([_EFFORT])] if kind == _EFFORT else []


def _tokens(name: str) -> list[str]:
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name)]
