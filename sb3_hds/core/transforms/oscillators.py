r"""
Oscillators that make gaits, in closed form.

A phase moves fast in one half of its cycle and slowly in the other:

.. math:: \dot\theta = \omega_{swing} \text{ if } \sin\theta > 0 \text{ else } \omega_{stance}

Derivatives exist with respect to everything. Those of a phase jump where it changes over between
swing and stance, and are right on both sides.
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
    :math:`\theta_i(0) = 0`, whose phase :math:`\theta_i + \varphi_i` swings and stands.

    Source: Raffin et al., *An Open-Loop Baseline for Reinforcement Learning Locomotion Tasks*,
    RLJ 2024, equation 1.

    :param amplitude: :math:`a`, in the unit of the joint: rad, m
    :param offset: :math:`b`, likewise
    :param phase: :math:`\varphi` [rad]
    :param omega_swing: while the sine is positive [rad/s], above 0
    :param omega_stance: while it is not [rad/s], above 0
    """

    amplitude: PerJoint
    offset: PerJoint
    phase: PerJoint
    omega_swing: Scalar
    omega_stance: Scalar


def period(omega_swing: Any, omega_stance: Any) -> Any:
    """:return: of one cycle [s]"""
    return math.pi / omega_swing + math.pi / omega_stance


def advance_phase(
    phase: Float[Any, "*shape"],
    duration: Float[Any, "*#shape"] | float,
    omega_swing: Float[Any, "*#shape"] | float,
    omega_stance: Float[Any, "*#shape"] | float,
) -> Float[Any, "*shape"]:
    """
    Takes arrays of NumPy and JAX alike.

    Where a phase is after some time, exactly: the cycle is two straight lines in time, so nothing
    is integrated. An Euler step of length h is late by up to ``h`` at each change-over, and the
    delays add up: ``h (omega_swing - omega_stance)`` rad per change-over at most.

    :param phase: any angle [rad]
    :param duration: 0 or more [s]
    :param omega_swing: [rad/s]
    :param omega_stance: [rad/s]
    :return: within one turn, from 0 to 2 pi [rad]
    """
    xp = phase.__array_namespace__()
    angle = xp.remainder(phase, 2.0 * math.pi)
    swing = math.pi / omega_swing
    gone = xp.where(angle < math.pi, angle / omega_swing, swing + (angle - math.pi) / omega_stance)
    gone = xp.remainder(gone + duration, period(omega_swing, omega_stance))
    in_swing, in_stance = gone * omega_swing, math.pi + (gone - swing) * omega_stance
    return xp.where(gone < swing, in_swing, in_stance)


def target_at(gait: Gait, time: Scalar | float) -> PerJoint:
    """:return: the wanted position of each joint ``time`` seconds after the start"""
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
