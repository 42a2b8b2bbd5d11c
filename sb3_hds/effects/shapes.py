"""Shapes that several effects share, with the derivatives that a search from null needs."""

import jax.numpy as jnp

from sb3_hds.core import JointMoment, Scalar

# Speed below which dry friction is smoothed [rad/s] or [m/s]: true friction jumps at standstill.
STANDSTILL = 0.01


def dry_friction(joint: JointMoment, level: Scalar | float) -> Scalar:
    r"""
    A force against the motion, :math:`-l \tanh(v / w)` with :math:`w = \max(0.01, l h / I)`.

    The sign function is smoothed over :math:`w`, which never falls below what a sub-step can stop.
    The error is below 0.5 % of the force at speeds above :math:`3 w`, and all of it at standstill.

    :param level: size of the force when sliding [N m] or [N], not negative
    :return: force on the joint [N m] or [N]
    """
    width = jnp.maximum(STANDSTILL, level * joint.h / joint.inertia)
    return -level * jnp.tanh(joint.v / width)


def beyond(x: Scalar, limit: Scalar | float) -> Scalar:
    """
    By how much ``x`` lies beyond ``limit`` on either side; zero in between.

    At a limit of zero it is ``x``, and so are its derivatives: one by ``x``, at zero too, and minus
    the sign of ``x`` by a growing limit.

    :param limit: not negative
    """
    return jnp.maximum(x - limit, 0.0) + jnp.minimum(x + limit, 0.0)
