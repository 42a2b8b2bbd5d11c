r"""
Oscillators for gaits, in closed form.

A phase has different frequencies in the two halves of its cycle:

.. math:: \dot\theta = \omega_{swing} \text{ if } \sin\theta > 0 \text{ else } \omega_{stance}

All functions are differentiable with respect to all arguments. Derivatives of a phase jump at the
transitions between swing and stance, and are correct on both sides.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sb3_hds.core.types import Scalar

PerJoint = Float[Array, " act"]


class Gait(NamedTuple):
    r"""
    One oscillator per joint, :math:`q_i(t) = a_i \sin(\theta_i(t) + \varphi_i) + b_i` with
    :math:`\theta_i(0) = 0`; swing and stance depend on :math:`\theta_i + \varphi_i`.

    Source: Raffin et al., *An Open-Loop Baseline for Reinforcement Learning Locomotion Tasks*,
    RLJ 2024, equation 1.

    :param amplitude: :math:`a` [rad] or [m]
    :param offset: :math:`b` [rad] or [m]
    :param phase: :math:`\varphi` [rad]
    :param omega_swing: frequency while the sine is positive [rad/s], above 0
    :param omega_stance: frequency while it is not [rad/s], above 0
    """

    amplitude: PerJoint
    offset: PerJoint
    phase: PerJoint
    omega_swing: Scalar
    omega_stance: Scalar


def period(omega_swing: Any, omega_stance: Any) -> Any:
    """:return: duration of one cycle [s]"""
    return math.pi / omega_swing + math.pi / omega_stance


def advance_phase(
    phase: Float[Any, "*shape"],
    duration: Float[Any, "*#shape"] | float,
    omega_swing: Float[Any, "*#shape"] | float,
    omega_stance: Float[Any, "*#shape"] | float,
) -> Float[Any, "*shape"]:
    """
    The exact phase after some time: it is piecewise linear, so nothing is integrated. Euler steps
    of length h are late by up to ``h`` at each transition, and these errors accumulate: at most
    ``h (omega_swing - omega_stance)`` rad per transition. Takes arrays of NumPy and JAX alike.

    :param phase: any angle [rad]
    :param duration: 0 or more [s]
    :param omega_swing: [rad/s]
    :param omega_stance: [rad/s]
    :return: the phase, from 0 to 2 pi [rad]
    """
    xp = phase.__array_namespace__()
    angle = xp.remainder(phase, 2.0 * math.pi)
    swing = math.pi / omega_swing
    time = xp.where(angle < math.pi, angle / omega_swing, swing + (angle - math.pi) / omega_stance)
    time = xp.remainder(time + duration, period(omega_swing, omega_stance))
    in_swing, in_stance = time * omega_swing, math.pi + (time - swing) * omega_stance
    return xp.where(time < swing, in_swing, in_stance)


def target_at(gait: Gait, time: Scalar | float) -> PerJoint:
    """:return: the target position of each joint ``time`` seconds after the start"""
    phase = advance_phase(gait.phase, time, gait.omega_swing, gait.omega_stance)
    return gait.amplitude * jnp.sin(phase) + gait.offset


_HALF, _QUARTER = math.pi, 0.5 * math.pi

#: phases of the legs front left, front right, hind left, hind right in each gait [rad]
LEADS: dict[str, tuple[float, float, float, float]] = {
    "trot": (0.0, _HALF, _HALF, 0.0),
    "pace": (0.0, _HALF, 0.0, _HALF),
    "bound": (0.0, 0.0, _HALF, _HALF),
    "walk": (0.0, _HALF, 3.0 * _QUARTER, _QUARTER),
}


def advance_amplitude(
    radius: Float[Any, " n"],
    speed: Float[Any, " n"],
    mu: Float[Any, " n"],
    dt: Scalar | float,
    gain: Scalar | float,
) -> tuple[Float[Any, " n"], Float[Any, " n"]]:
    r"""
    Amplitudes that follow their commands:

    .. math:: \ddot r = a \left(\tfrac{a}{4} (\mu - r) - \dot r\right)

    The equation is linear and critically damped, so it is solved exactly while the command is
    held, with :math:`e = r - \mu` and :math:`k = a/2`:
    :math:`e(t) = (e_0 + (\dot r_0 + k e_0)\,t)\,e^{-kt}`. Takes arrays of NumPy and JAX alike.

    Source: Bellegarda and Ijspeert, *CPG-RL: Learning central pattern generators for quadruped
    locomotion*, RA-L 2022, equation 1.

    :param radius: amplitude of each oscillator
    :param speed: its time derivative [1/s]
    :param mu: commanded amplitudes
    :param dt: how long the commands are held [s]
    :param gain: :math:`a` [1/s]
    :return: amplitudes and their time derivatives ``dt`` later
    """
    k, error = 0.5 * gain, radius - mu
    decay = radius.__array_namespace__().exp(-k * dt)
    slope = speed + k * error
    error = error + slope * dt
    return mu + error * decay, (slope - k * error) * decay
