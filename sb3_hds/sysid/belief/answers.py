"""The answers that a diagnosis leaves open, as parameter vectors of one twin."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sb3_hds.core import Effect, ExtendedTwin, Parameter, Twin
from sb3_hds.core.twin import layers_of
from sb3_hds.effects import CoulombFriction, ViscousFriction

# Standard deviation of a parameter that the data do not determine, in units of its scale.
_UNKNOWN = 3.0
# Weight from which the likeliest answer is settled.
_SETTLED = 0.95


class Answer(NamedTuple):
    """
    One answer that the data leave open.

    :param causes: keys of the causes, as ``"coulomb_friction.hinge"``; none: the nominal model is
        right
    :param twin: nominal model with these causes, fitted to all data
    :param factor: by name of a parameter of ``twin``, a row of the matrix :math:`L` with which
        :math:`L L^T` is the joint covariance of all of them, in their units, shape ``(k,)``
    :param log_weight: logarithm of held-out likelihood and prior odds, up to a constant
    """

    causes: tuple[str, ...]
    twin: Twin
    factor: dict[str, np.ndarray]
    log_weight: float = 0.0

    @property
    def name(self) -> str:
        """The causes in one line."""
        return " + ".join(self.causes) or "nothing is wrong"


@dataclasses.dataclass(frozen=True, eq=False)
class Answers:
    """
    The answers of a diagnosis.

    :param answers: the likeliest first
    :param noise: standard deviation of each channel's residual under the best answer, shape
        ``(n_obs,)``
    :param correlated: rows of these residuals for each independent one; 1 for white noise
    :param window: length of the windows in which answers were compared, in steps of the twin
    :param start: observation from which a recording may begin: the slowest start of the recordings,
        shape ``(n_obs,)``
    """

    answers: tuple[Answer, ...]
    noise: Float[np.ndarray, " obs"]
    correlated: float
    window: int
    start: Float[np.ndarray, " obs"]

    @property
    def weights(self) -> Float[np.ndarray, " answers"]:
        """Normalised weights of the answers."""
        logs = np.array([answer.log_weight for answer in self.answers])
        weights = np.exp(logs - logs.max())
        return weights / weights.sum()

    @property
    def settled(self) -> bool:
        """Whether the likeliest has 95 % of the weight."""
        return bool(self.weights[0] >= _SETTLED)

    def __str__(self) -> str:
        """The answers, with their weights."""
        lines = [
            f"{weight:7.1%}  {answer.name}"
            for answer, weight in zip(self.answers, self.weights, strict=True)
        ]
        return "\n".join(lines)

    @property
    def twin(self) -> Twin:
        """The union: every answer's effects, with the values of the likeliest answer."""
        return union(self.answers)[0]


def union(answers: Sequence[Answer]) -> tuple[Twin, np.ndarray, np.ndarray]:
    """
    One twin with the effects of all answers: those that an answer does not have are at their null.

    :param answers: whose twins extend the same twin
    :return: that twin with the values of the first answer; parameters of each answer in the order
        of ``twin.parameters``, shape ``(m, p)``; and factors of their covariances, shape
        ``(m, p, k)``, filled up with zeros
    """
    first, *others = (answer.twin for answer in answers)
    twin, there = first, {effect_key(e) for e in effects_of(first)}
    for other in others:
        new = [effect for effect in effects_of(other) if effect_key(effect) not in there]
        there |= {effect_key(effect) for effect in new}
        nulls = [e.with_values(**{n: p.null for n, p in e.parameters.items()}) for e in new]
        twin = twin.extend(*nulls) if nulls else twin
    names = tuple(twin.parameters)
    null = {name: twin.parameters[name].null for name in names}
    values = np.array(
        [[answer.twin.values.get(name, null[name]) for name in names] for answer in answers]
    )
    most = max((len(row) for a in answers for row in a.factor.values()), default=1)
    factor = np.zeros((len(answers), len(names), most))
    for own, answer in zip(factor, answers, strict=True):
        for name, row in answer.factor.items():
            own[names.index(name), : len(row)] = row
    return twin, values, factor


def bounds_of(twin: Twin) -> tuple[np.ndarray, np.ndarray]:
    """:return: smallest and largest values of all parameters, each of shape ``(p,)``"""
    parameters = twin.parameters.values()
    return np.array([p.lower for p in parameters]), np.array([p.upper for p in parameters])


def effects_of(twin: Twin) -> tuple[Effect, ...]:
    """:return: the effects that are attached, holding their values"""
    extended = (layer for layer in layers_of(twin) if isinstance(layer, ExtendedTwin))
    return tuple(effect for layer in extended for effect in layer.effects_with_values())


def effect_key(effect: Effect) -> str:
    """:return: name and place of an attached effect"""
    return f"{effect.name}.{effect.where}"


def everything_open(twin: Twin) -> Answer:
    """
    :return: this twin, with friction of size zero at each joint, as an answer whose parameters are
        uncertain by their scales, apart from the known ones
    """
    there = {effect_key(effect) for effect in effects_of(twin)}
    friction = [
        kind(joint.name)
        for kind in (ViscousFriction, CoulombFriction)
        for joint in twin.joints
        if f"{kind.name}.{joint.name}" not in there
    ]
    extended = twin.extend(*friction) if friction else twin
    free = [name for name in extended.parameters if name not in extended.known_parameters]
    scales = np.diag([_scale_of(extended.parameters[name]) for name in free])
    return Answer((), extended, dict(zip(free, scales, strict=True)))


def _scale_of(parameter: Parameter) -> float:
    """:return: the parameter's scale, or the distance of its bounds if that is smaller"""
    width = parameter.upper - parameter.lower
    return min(parameter.scale, width) if math.isfinite(width) else parameter.scale


def factor_of(covariance: Float[np.ndarray, "k k"], scale: Float[np.ndarray, " k"]) -> np.ndarray:
    """
    :param covariance: of ``k`` parameters, possibly singular or infinite
    :param scale: typical deviation of each
    :return: :math:`L` with :math:`L L^T` the covariance, no direction of which is wider than three
        typical deviations, shape ``(k, k)``
    """
    scaled = covariance / np.outer(scale, scale)
    unknown = ~np.isfinite(np.diag(scaled)) | ~np.isfinite(scaled).all(1)
    scaled = np.where(np.logical_or.outer(unknown, unknown), 0.0, scaled)
    scaled[unknown, unknown] = _UNKNOWN**2
    power, directions = np.linalg.eigh(0.5 * (scaled + scaled.T))
    deviations = np.sqrt(np.clip(power, 0.0, _UNKNOWN**2))
    return scale[:, None] * directions * deviations
