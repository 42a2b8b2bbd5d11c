"""Shapes that several effects share, with the derivatives that a search from null needs."""

import dataclasses
import math
from collections.abc import Mapping

import jax.numpy as jnp

from sb3_hds.core import Effect, JointMoment, Parameter, Scalar
from sb3_hds.errors import EffectError

# Speed below which dry friction is smoothed where nobody says [rad/s] or [m/s].
STANDSTILL = 0.01


def dry_friction(
    joint: JointMoment,
    level: Scalar | float,
    standstill: Scalar | float = STANDSTILL,
) -> Scalar:
    r"""
    A force against the motion, :math:`-l \tanh(v / w)` with :math:`w = \max(w_0, l h / I)`.

    The sign function is smoothed over :math:`w`, which never falls below what a sub-step can stop.
    The error is below 0.5 % of the force at speeds above :math:`3 w`, and all of it at standstill.

    :param level: size of the force when sliding [N m] or [N], not negative
    :param standstill: :math:`w_0`, speed below which it is smoothed [rad/s] or [m/s]
    :return: force on the joint [N m] or [N]
    """
    width = jnp.maximum(standstill, level * joint.h / joint.inertia)
    return -level * jnp.tanh(joint.v / width)


def beyond(x: Scalar, limit: Scalar | float) -> Scalar:
    """
    By how much ``x`` lies beyond ``limit`` on either side; zero in between.

    At a limit of zero it is ``x``, and so are its derivatives: one by ``x``, at zero too, and minus
    the sign of ``x`` by a growing limit.

    :param limit: not negative
    """
    return jnp.maximum(x - limit, 0.0) + jnp.minimum(x + limit, 0.0)


def limited(effect: Effect, name: str, longest: float) -> tuple[float, Mapping[str, Parameter]]:
    """
    :param name: of the parameter that may not exceed ``longest``
    :return: that limit, and the effect's parameters with it
    :raises EffectError: unless it is positive
    """
    if not (isinstance(longest, int | float) and 0.0 < longest < math.inf):
        raise EffectError(f"longest is a positive time in seconds, got {longest!r}.")
    own = dict(type(effect).parameters)
    scale = min(own[name].scale, 0.5 * longest)
    own[name] = dataclasses.replace(own[name], upper=float(longest), scale=scale)
    return float(longest), own
