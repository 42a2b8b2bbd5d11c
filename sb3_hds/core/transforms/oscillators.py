r"""
Oscillators that make gaits: functions of time, or of a state that is integrated.

A phase moves fast in one half of its cycle and slowly in the other:

.. math:: \dot\theta = \omega_{swing} \text{ if } \sin\theta > 0 \text{ else } \omega_{stance}

Derivatives exist with respect to everything. Those of a phase jump where it changes over between
swing and stance, and are right on both sides.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sb3_hds.core.types import Scalar
from sb3_hds.errors import ParameterError

PerJoint = Float[Array, " act"]
PerLeg = Float[Array, " leg"]
Offsets = Float[Array, "leg leg"]


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


def phase_at(gait: Gait, time: Scalar | float) -> PerJoint:
    """:return: the phase of each joint ``time`` seconds after the start [rad], exactly"""
    return advance_phase(gait.phase, time, gait.omega_swing, gait.omega_stance)


def target_at(gait: Gait, time: Scalar | float) -> PerJoint:
    """:return: the wanted position of each joint ``time`` seconds after the start"""
    return gait.amplitude * jnp.sin(phase_at(gait, time)) + gait.offset


class Hopf(NamedTuple):
    r"""
    Coupled Hopf oscillators, one for each leg:

    .. math::

        \dot r_i = \alpha (\mu - r_i^2) r_i, \qquad \dot\varphi_i = \omega(\varphi_i)
        + \sum_j w_{ij}\, r_j \sin(\varphi_j - \varphi_i - \Phi_{ij})

    with the frequency of swing or stance. Source: Righetti and Ijspeert, *Pattern generators with
    sensory feedback for the control of quadruped locomotion*, ICRA 2008; in this form Raffin et
    al., *Learning to exploit elastic actuators for quadruped locomotion*, 2022, equation 1.

    :param omega_swing: [rad/s]
    :param omega_stance: [rad/s]
    :param offsets: :math:`\Phi_{ij}`, by how much leg j is ahead of leg i [rad], see :data:`LEADS`
    :param coupling: :math:`w_{ij}`, how hard leg j pulls at leg i [1/s]: a matrix, or one number
        for all pairs
    :param alpha: how fast amplitudes settle [1/s]
    :param mu: square of the amplitude they settle at
    """

    omega_swing: Scalar | float
    omega_stance: Scalar | float
    offsets: Offsets
    coupling: Offsets | Scalar | float = 1.0
    alpha: Scalar | float = 50.0
    mu: Scalar | float = 1.0


class HopfState(NamedTuple):
    """
    :param radius: amplitude of each oscillator
    :param phase: of each [rad], not wrapped
    """

    radius: PerLeg
    phase: PerLeg


def coupling_offsets(lead: PerLeg) -> Offsets:
    """
    :param lead: phase of each leg in the wanted gait, up to one that all share [rad]
    :return: :math:`\\Phi_{ij}` = lead of j minus lead of i: at rest exactly in that gait
    """
    lead = jnp.asarray(lead)
    return lead[None, :] - lead[:, None]


_HALF, _QUARTER = math.pi, 0.5 * math.pi

#: phases of the legs front left, front right, hind left, hind right in each gait [rad]
LEADS: dict[str, tuple[float, float, float, float]] = {
    "trot": (0.0, _HALF, _HALF, 0.0),
    "pace": (0.0, _HALF, 0.0, _HALF),
    "bound": (0.0, 0.0, _HALF, _HALF),
    "walk": (0.0, _HALF, 3.0 * _QUARTER, _QUARTER),
}


def hopf_rate(state: HopfState, hopf: Hopf) -> HopfState:
    """
    :return: the time derivative of the state
    :raises ParameterError: for weights that are neither one number nor one for each pair of legs
    """
    radius, phase = state
    if jnp.shape(hopf.coupling) not in ((), hopf.offsets.shape):
        raise ParameterError(
            f"Hopf(coupling=...) has the shape {jnp.shape(hopf.coupling)}. Pass one number, or one "
            f"for each pair of legs, of shape {hopf.offsets.shape}."
        )
    ahead = phase[None, :] - phase[:, None] - hopf.offsets
    pull = jnp.sum(hopf.coupling * radius[None, :] * jnp.sin(ahead), axis=1)
    omega = jnp.where(jnp.sin(phase) > 0.0, hopf.omega_swing, hopf.omega_stance)
    return HopfState(hopf.alpha * (hopf.mu - radius**2) * radius, omega + pull)


def advance_hopf(state: HopfState, hopf: Hopf, dt: float, substeps: int) -> HopfState:
    """
    Integrate by the classical Runge-Kutta method.

    Where a phase changes over between swing and stance inside a sub-step of length h, it is off by
    at most ``h |omega_swing - omega_stance|``, twice in each cycle; otherwise the error is of
    fourth order.

    :param dt: [s]
    :param substeps: in ``dt``
    :return: the state ``dt`` later
    """
    h = dt / substeps

    def step(now: HopfState, _: None) -> tuple[HopfState, None]:
        k1 = hopf_rate(now, hopf)
        k2 = hopf_rate(_moved(now, k1, 0.5 * h), hopf)
        k3 = hopf_rate(_moved(now, k2, 0.5 * h), hopf)
        k4 = hopf_rate(_moved(now, k3, h), hopf)
        rate = jax.tree.map(lambda a, b, c, d: (a + 2.0 * b + 2.0 * c + d) / 6.0, k1, k2, k3, k4)
        return _moved(now, rate, h), None

    return jax.lax.scan(step, state, None, substeps)[0]


class AmplitudeState(NamedTuple):
    """
    Arrays of NumPy or JAX.

    :param radius: amplitude of each oscillator
    :param speed: its time derivative [1/s]
    :param phase: of each [rad], within one turn
    """

    radius: Float[Any, " n"]
    speed: Float[Any, " n"]
    phase: Float[Any, " n"]


def advance_amplitude(
    state: AmplitudeState,
    mu: Float[Any, " n"],
    omega: Float[Any, " #n"] | Scalar | float,
    dt: Scalar | float,
    gain: Scalar | float = 150.0,
) -> AmplitudeState:
    r"""
    Oscillators whose amplitude and frequency are commanded, not coupled to each other:

    .. math:: \ddot r = a \left(\tfrac{a}{4} (\mu - r) - \dot r\right), \qquad \dot\theta = \omega

    The first is critically damped and linear, so while the commands are held both are solved
    exactly, with :math:`e = r - \mu` and :math:`k = a/2`:
    :math:`e(t) = (e_0 + (\dot r_0 + k e_0)\,t)\,e^{-kt}`.

    Source: Bellegarda and Ijspeert, *CPG-RL: Learning central pattern generators for quadruped
    locomotion*, RA-L 2022, equations 1 and 2.

    :param mu: amplitudes to settle at
    :param omega: [rad/s]
    :param dt: how long the commands are held [s]
    :param gain: :math:`a` [1/s]
    :return: the state ``dt`` later
    """
    k, xp = 0.5 * gain, state.radius.__array_namespace__()
    error = state.radius - mu
    slope = state.speed + k * error
    decay = xp.exp(-k * dt)
    radius = mu + (error + slope * dt) * decay
    speed = (slope - k * (error + slope * dt)) * decay
    return AmplitudeState(radius, speed, (state.phase + omega * dt) % (2.0 * math.pi))


def _moved(state: HopfState, rate: HopfState, h: float) -> HopfState:
    return jax.tree.map(lambda x, dx: x + h * dx, state, rate)
