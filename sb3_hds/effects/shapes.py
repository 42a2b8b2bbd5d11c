"""Shared by several effects: nonlinearities with the right derivative at null, and delays."""

import dataclasses
import math

import jax.numpy as jnp

from sb3_hds.core import Effect, JointMoment, Parameter, Scalar
from sb3_hds.errors import EffectError

# Default speed below which dry friction is smoothed [rad/s] or [m/s].
STANDSTILL = 0.01
# Longest delay that can be simulated by default [s].
_LONGEST_DELAY = 0.2


def dry_friction(
    joint: JointMoment,
    level: Scalar | float,
    standstill: Scalar | float = STANDSTILL,
) -> Scalar:
    r"""
    A force against the motion, :math:`-l \tanh(v / w)` with :math:`w = \max(w_0, l h / I)`.

    The sign function is smoothed over :math:`w`, at least the speed that a sub-step can stop. The
    error is below 0.5 % of the force at speeds above :math:`3 w`, and 100 % at standstill.

    :param level: size of the force when sliding [N m] or [N], not negative
    :param standstill: :math:`w_0`, speed below which it is smoothed [rad/s] or [m/s]
    :return: force on the joint [N m] or [N]
    """
    width = jnp.maximum(standstill, level * joint.h / joint.inertia)
    return -level * jnp.tanh(joint.v / width)


def beyond(x: Scalar, limit: Scalar | float) -> Scalar:
    """
    The excess of ``x`` over ``limit`` on either side; zero in between.

    At a limit of zero it equals ``x``, with a derivative of one by ``x``, at zero, too, and of
    minus the sign of ``x`` by a growing limit.

    :param limit: not negative
    """
    return jnp.maximum(x - limit, 0.0) + jnp.minimum(x + limit, 0.0)


class Delayed(Effect):
    """
    Abstract: a signal arrives late.

    :param longest: option; longest delay that can be simulated [s]
    :raises EffectError: unless it is positive
    """

    options = ("longest",)
    parameters = {
        "delay": Parameter(null=0.0, scale=0.02, unit="s", lower=0.0, upper=_LONGEST_DELAY)
    }

    def __init__(
        self, where: int | str = 0, *, longest: float = _LONGEST_DELAY, **values: float
    ) -> None:
        if not (isinstance(longest, int | float) and 0.0 < longest < math.inf):
            raise EffectError(f"longest is a positive time in seconds, got {longest!r}.")
        self.longest = float(longest)
        delay = type(self).parameters["delay"]
        scale = min(delay.scale, 0.5 * self.longest)
        own = {"delay": dataclasses.replace(delay, upper=self.longest, scale=scale)}
        self.parameters = own  # type: ignore[misc]  # with a limit of its own
        super().__init__(where, **values)

    def remembered(self, dt: float) -> int:
        """:return: number of control intervals that a memory must hold, including the current"""
        return math.ceil(self.longest / dt - 1e-9) + 1
