"""Limits of a machine during identification."""

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_hds.core import AnalyticTwin, Twin
from sb3_hds.core.twin import plant_of
from sb3_hds.errors import ParameterError, did_you_mean

#: quantities whose largest absolute value is limited at each joint
BY_JOINT = ("velocity", "torque", "power", "jerk")

Given = float | Sequence[float] | Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class Limits:
    """
    Limits of a machine. Each is a number or a pair for all joints, or one by name:
    ``{"shoulder": 2.0}``; a joint that is not named has none.

    :param position: smallest and largest position of joints [rad] or [m]; default: what the twin's
        joints declare
    :param velocity: largest speed [rad/s] or [m/s]
    :param torque: largest force of the actuators at a joint [N m] or [N]
    :param power: largest mechanical power of the actuators at a joint, either way [W]
    :param jerk: largest rate of change of acceleration [rad/s3] or [m/s3]
    :param command: smallest and largest command of actuators, in their units; default: what the
        twin's actuators accept
    :param bandwidth: highest frequency in the commands [Hz]; default: a tenth of the sampling rate
    """

    position: Given | None = None
    velocity: Given | None = None
    torque: Given | None = None
    power: Given | None = None
    jerk: Given | None = None
    command: Given | None = None
    bandwidth: float | None = None

    @classmethod
    def of(cls, given: "Limits | Mapping[str, Any] | str | os.PathLike[str]") -> "Limits":
        """
        :param given: limits, a dictionary of them, or a yml file with one
        :raises ParameterError: for something else, or an unknown limit
        :raises OSError: if there is no such file
        """
        if isinstance(given, Limits):
            return given
        if isinstance(given, str | os.PathLike):
            import yaml

            path, text = given, Path(given).read_text(encoding="utf-8")
            try:
                given = yaml.safe_load(text) or {}
            except yaml.YAMLError as error:
                words = " ".join(str(error).split())
                raise ParameterError(f"{path} is no yml: {words}.") from None
        known = [field.name for field in dataclasses.fields(cls)]
        if not isinstance(given, Mapping):
            raise ParameterError(
                f"limits are a dictionary, such as {{'velocity': 6.0}}, or a yml file with one, "
                f"got {given!r}. There are: {', '.join(known)}."
            )
        for name in given:
            if name not in known:
                raise ParameterError(
                    f"There is no limit '{name}'.{did_you_mean(str(name), known)} There are: "
                    f"{', '.join(known)}."
                )
        return cls(**given)

    def at(self, twin: Twin) -> "Bounds":
        """
        :return: arrays for the joints and actuators of this twin
        :raises ParameterError: for a name that it does not have, a limit that is no positive number
            or no ascending pair, a command without limits, or a torque that it does not compute
        """
        joints, actuators = [j.name for j in twin.joints], [a.name for a in twin.actuators]
        if not actuators:
            raise ParameterError(
                f"{twin.name} has no actuator, so there are no commands to choose. Record it from "
                "other start states."
            )
        needs_force = [name for name in ("torque", "power") if getattr(self, name) is not None]
        if needs_force and not isinstance(plant_of(twin), AnalyticTwin):
            raise ParameterError(
                f"{twin.name} does not compute the force of its actuators, so it cannot keep a "
                f"limit of {' and '.join(needs_force)}. Limit the command instead."
            )
        ranges = [(j.low, j.high) for j in twin.joints]
        position = _pairs("position", self.position, joints, ranges)
        ranges = [(a.low, a.high) for a in twin.actuators]
        command = _pairs("command", self.command, actuators, ranges)
        for name, (low, high) in zip(actuators, command, strict=True):
            if not (math.isfinite(low) and math.isfinite(high)):
                raise ParameterError(
                    f"The command of {name} has no limits in {twin.name}. Give it some: "
                    f"command: {{{name}: [-1.0, 1.0]}}."
                )
        most = {n: _largest(n, getattr(self, n), joints) for n in BY_JOINT}
        highest = 0.1 / twin.dt if self.bandwidth is None else self.bandwidth
        if not (_is_number(highest) and 0.0 < highest <= 0.5 / twin.dt):
            raise ParameterError(
                f"bandwidth must lie between 0 and half the sampling rate, {0.5 / twin.dt:g} Hz, "
                f"got {highest!r}."
            )
        return Bounds(position, command, **most, bandwidth=float(highest))


@dataclasses.dataclass(frozen=True, eq=False)
class Bounds:
    """
    :class:`Limits` of one twin, as arrays; what is not limited is infinite.

    :param position: shape ``(dof, 2)``
    :param command: shape ``(n_act, 2)``
    :param velocity: shape ``(dof,)``, as all below
    """

    position: np.ndarray
    command: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray
    power: np.ndarray
    jerk: np.ndarray
    bandwidth: float


def _pairs(
    limit: str, given: Given | None, names: list[str], default: list[tuple[float, float]]
) -> np.ndarray:
    found = np.array(default, float)
    for i, own in _by_name(limit, given, names):
        own = (-own, own) if _is_number(own) else own
        pair = isinstance(own, Sequence) and len(own) == 2 and all(map(_is_number, own))
        if not (pair and own[0] < own[1]):
            raise ParameterError(
                f"The limit of {limit} must be a smallest and a larger largest value, such as "
                f"[-1.0, 1.0], got {own!r} for {names[i]}."
            )
        found[i] = max(own[0], found[i, 0]), min(own[1], found[i, 1])
        if not found[i, 0] < found[i, 1]:
            raise ParameterError(
                f"The limit of {limit} {list(own)} of {names[i]} leaves nothing of what the twin "
                f"allows, {list(default[i])}."
            )
    return found


def _largest(limit: str, given: Given | None, names: list[str]) -> np.ndarray:
    found = np.full(len(names), np.inf)
    for i, own in _by_name(limit, given, names):
        if not (_is_number(own) and own > 0.0):
            raise ParameterError(
                f"The limit of {limit} must be a positive number, got {own!r} for {names[i]}."
            )
        found[i] = own
    return found


def _by_name(limit: str, given: Given | None, names: list[str]) -> list[tuple[int, Any]]:
    """:return: index and value of each joint or actuator that has a limit"""
    if given is None:
        return []
    if not isinstance(given, Mapping):
        return [(i, given) for i in range(len(names))]
    unknown = [str(name) for name in given if name not in names]
    if unknown:
        raise ParameterError(
            f"The limit of {limit} names {unknown[0]}.{did_you_mean(unknown[0], names)} There are: "
            f"{', '.join(names)}."
        )
    return [(names.index(name), own) for name, own in given.items()]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
