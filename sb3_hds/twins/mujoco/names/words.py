"""The words of the names of columns and joints."""

import dataclasses
import re
from typing import NamedTuple

POSITION, VELOCITY, EFFORT, COMMAND = "position", "velocity", "effort", "command"
# Their names in logs of ROS, LeRobot and others.
_WORDS = {
    POSITION: ("position", "positions", "pos", "qpos", "q", "angle", "angles"),
    VELOCITY: ("velocity", "velocities", "vel", "qvel", "qd", "dq", "speed", "rate"),
    EFFORT: ("effort", "efforts", "torque", "torques", "tau", "force", "current"),
    COMMAND: (
        *("command", "commands", "cmd", "target", "targets", "goal", "action", "setpoint"),
        *("desired", "des", "reference", "ref", "control", "ctrl"),
    ),
}
_KIND_OF = {word: kind for kind, words in _WORDS.items() for word in words}
# Words that do not distinguish joints.
_IGNORED = {"joint", "joints", "state", "states", "observation", "obs"}


class Signal(NamedTuple):
    """
    A channel or actuator of a twin.

    :param name: of the channel or actuator
    :param joint: name of its joint; of an actuator that shares one, its own
    :param kinds: quantities that its column may have, the best first
    """

    name: str
    joint: str
    kinds: tuple[frozenset[str], ...]


@dataclasses.dataclass(frozen=True)
class Parsed:
    """
    :param joint: the words of a column's name that may be those of a joint
    :param kinds: the quantities that it names; without any, it is a position
    :param told: whether it names any
    """

    joint: tuple[str, ...]
    kinds: frozenset[str]
    told: bool

    @classmethod
    def of(cls, name: str) -> "Parsed":
        words = tokens(name)
        kinds = frozenset(_KIND_OF[word] for word in words if word in _KIND_OF)
        joint = tuple(word for word in words if word not in _KIND_OF and word not in _IGNORED)
        return cls(joint, kinds or frozenset([POSITION]), bool(kinds))

    def rest(self, joint: str) -> tuple[str, ...]:
        """:return: words that are not in the name of the joint"""
        own = Parsed.of(joint).joint
        return tuple(word for word in self.joint if word not in own)

    def score(self, joint: str) -> float:
        """:return: 0 for another joint, otherwise the share of the joint's words in the name"""
        wanted = Parsed.of(joint).joint
        n = len(wanted)
        if not n or not self.joint:
            return float(self.joint == wanted)
        inside = any(self.joint[i : i + n] == wanted for i in range(len(self.joint) - n + 1))
        return n / len(self.joint) if inside else 0.0


def tokens(name: str) -> list[str]:
    """:return: words and numbers of a name, in lower case"""
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name)]


def is_current(name: str) -> bool:
    """:return: whether a column of an effort has the name of a motor current [A]"""
    return "current" in tokens(name)
