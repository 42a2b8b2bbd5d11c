"""The equation of motion as a regression: a row for each interval, columns for candidates."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from sb3_hds.core import Effect, Ranges, Twin
from sb3_hds.sysid.equation.terms import Terms
from sb3_hds.sysid.estimation.candidates import Candidate
from sb3_hds.sysid.motion.motion import Motion

#: added to the norms by which columns are divided; its square is not zero
TINY = 1e-100
# Finite differences by a parameter or a sensor, in shares of its scale.
STEP = 1e-3

# Added to the diagonal of scaled normal equations.
_RIDGE = 1e-9

Rule = Literal["linear", "chain", "blend"]


class Solution(NamedTuple):
    """
    :param rss: residual sum of squares, in units of the noise
    :param free: columns whose coefficients were estimated
    :param theta: coefficients
    :param inverse: of their normal matrix
    :param weights: of all columns in the residual; the last is that of the residual force
    :param held: columns whose coefficients are at a bound
    :param gains: of columns that act on a command, its gain in this set
    """

    rss: float
    free: list[int]
    theta: np.ndarray
    inverse: np.ndarray
    weights: np.ndarray
    held: tuple[int, ...]
    gains: Mapping[int, float] = {}

    @property
    def value(self) -> dict[int, float]:
        """Coefficients by column."""
        found = dict(zip(self.free, map(float, self.theta), strict=True))
        found |= {c: -float(self.weights[c]) for c in self.held}
        return found | {c: found[c] / gain for c, gain in self.gains.items() if c in found}


def least_squares(
    gram: np.ndarray, weights: np.ndarray, free: list[int], prior: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """:return: coefficients, and the inverse of their normal matrix; None if there is none"""
    if not free:
        return np.zeros(0), np.zeros((0, 0))
    fixed = weights.copy()
    fixed[free] = 0.0
    inner = gram[np.ix_(free, free)] + np.diag(prior)
    size = np.sqrt(np.diag(inner)) + TINY
    scaled = inner / np.outer(size, size) + _RIDGE * np.eye(len(free))
    try:
        inverse = np.linalg.inv(scaled)
    except np.linalg.LinAlgError:
        return np.zeros(len(free)), None
    theta = inverse @ ((gram[free] @ fixed) / size) / size
    if not np.isfinite(theta).all():
        return np.zeros(len(free)), None
    return theta, inverse / np.outer(size, size)


def squares(weights: np.ndarray, gram: np.ndarray) -> np.ndarray:
    """
    :param weights: of the columns, shape ``(columns,)``
    :param gram: normal equations, shape ``(..., columns, columns)``
    :return: sums of squares of the weighted columns' sum, shape ``(...)``
    """
    on = np.flatnonzero(weights)
    return np.einsum("i,...ik,k->...", weights[on], gram[..., on[:, None], on], weights[on])


@dataclasses.dataclass(frozen=True)
class Item:
    """
    A candidate with its nonlinear parameters at fixed values, or between two.

    :param candidate: which
    :param columns: indices; of a ``"chain"``, the first has the coefficient one
    :param names: short name of the parameter of each column
    :param rule: how coefficients become sizes
    :param settings: values of its parameters, by short name, at which the columns were taken
    """

    candidate: Candidate
    columns: tuple[int, ...]
    names: tuple[str, ...]
    rule: Rule = "linear"
    settings: tuple[Mapping[str, float], ...] = ()

    @property
    def key(self) -> str:
        return self.candidate.key

    @property
    def free(self) -> tuple[int, ...]:
        """Columns whose coefficients are estimated."""
        return self.columns[1:] if self.rule == "chain" else self.columns

    def sizes(
        self, effect: Effect | None, coefficients: Sequence[float] | np.ndarray
    ) -> dict[str, float]:
        """
        :param effect: the candidate's; None for a parameter
        :param coefficients: of the free columns
        :return: values of the candidate's parameters by short name; of a parameter, its change
        """
        if self.rule == "chain":
            (name,), (low, high) = self.names[-1:], self.settings
            share = float(coefficients[0])
            return {name: low[name] + share * (high[name] - low[name])}
        if self.rule == "blend":
            assert effect is not None
            return effect.blend((coefficients[0], coefficients[1]), self.settings)  # type: ignore[arg-type]
        found = dict(self.settings[0]) if self.settings else {}
        for name, value in zip(self.names, coefficients, strict=True):
            null = effect.parameters[name].null if effect is not None else 0.0
            found[name] = null + float(value)
        return found


class Column(NamedTuple):
    """
    :param joint: at which it acts; None: at all, and ``values`` has a column for each
    :param values: force at each interval, shape ``(n,)`` or ``(n, dof)`` [N m] or [N]
    """

    joint: int | None
    values: np.ndarray

    def at(self, joint: int) -> np.ndarray | None:
        """:return: force at one joint; None if there is none"""
        if self.joint is None:
            return self.values[:, joint]
        return self.values if self.joint == joint else None


class Rows(NamedTuple):
    """All recordings, one after the other: where intervals begin and end."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    change: np.ndarray  # of the smoothed velocity
    measured: np.ndarray  # of the measured velocity
    actions: np.ndarray
    recording: np.ndarray
    next_q: np.ndarray
    next_v: np.ndarray


@dataclasses.dataclass
class Equation:
    """
    The equation of motion along all recordings, one row for each interval.

    :param twin: nominal model, at the interval of the motion
    :param motion: from which it was made
    :param rows: of the motion
    :param terms: of the nominal model in these rows
    :param effective_inertia: over an interval, force over change of velocity with
        damping, shape ``(n, dof, dof)``
    :param load: force that the nominal model transmits: inertia, gravity, shape ``(n, dof)``
    :param residual: residual force of the nominal model, shape ``(n, dof)`` [N m] or [N]
    :param smooth: the same with smoothed velocities
    :param columns: what candidates would add
    :param items: candidates, several with different settings
    :param noisy: of columns that contain the acceleration, smoothed, the index of the same column
        with the measured one
    :param slopes: of the mass matrix by inertial parameters, by key of the candidate
    :param drives: relative change of the actuators' force with a unit of a parameter at each joint,
        by key of the candidate
    """

    twin: Twin
    motion: Motion
    rows: Rows
    terms: Terms
    effective_inertia: np.ndarray
    load: np.ndarray
    residual: np.ndarray
    smooth: np.ndarray
    columns: list[Column] = dataclasses.field(default_factory=list)
    items: list[Item] = dataclasses.field(default_factory=list)
    noisy: dict[int, int] = dataclasses.field(default_factory=dict)
    slopes: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    drives: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)


def residual_force(inertia: np.ndarray, change: np.ndarray, dt: float) -> np.ndarray:
    """:return: force that changes velocities by this much in an interval, shape ``(n, dof)``"""
    return np.einsum("nij,nj->ni", inertia, change) / dt


def put(made: Equation, joint: int | None, values: np.ndarray) -> int:
    """:return: index of a new column"""
    made.columns.append(Column(joint, values))
    return len(made.columns) - 1


def put_acting(made: Equation, values: np.ndarray) -> int:
    """:return: index of a new column, at a single joint if it acts at only one"""
    acting = np.flatnonzero(np.abs(values).max(0) > 0.0)
    if len(acting) == 1:
        return put(made, int(acting[0]), values[:, acting[0]])
    return put(made, None, values)


def ranges_of(made: Equation, joint: int | None, actuator: int | None) -> Ranges:
    """:return: ranges of the motion and the commands, from which effects choose their settings"""
    motion, command = made.motion, np.zeros(1)
    if actuator is not None:
        command = made.rows.actions[:, actuator]
    own = slice(None) if joint is None else slice(joint, joint + 1)
    return Ranges(
        excursion=float(np.max(motion.excursion[own])),
        speed=float(np.max(motion.speed[own])),
        command=float(np.sqrt(np.mean(command**2))),
        largest=float(np.abs(command).max()),
        dt=motion.dt,
        period=float(np.min(motion.period[own])),
        turn=motion.turn[joint] if joint is not None else np.inf,
    )
