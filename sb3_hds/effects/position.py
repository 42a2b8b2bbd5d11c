"""Forces that depend on the position of a joint, and constant ones."""

import math
from collections.abc import Mapping

import jax.numpy as jnp

from sb3_hds.core import JointEffect, JointMoment, Memory, Parameter, Params, Ranges, Scalar

# Initial values of a search: numbers of periods in the range of motion, dense enough for a fit to
# find those in between, and phases as shares of a period.
_CYCLES = (0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0, 12.0)
_PHASES = (0.0, 0.25, 0.5, 0.75)
# Values of the grid: the longest period divided by these. It fits twice into the range of motion,
# since longer waves look like springs, and four times into a turn, since gravity has one period per
# turn.
_DIVISORS = (*(1.0 + 0.125 * k for k in range(17)), *(3.25 + 0.25 * k for k in range(20)))
_LONGEST = 0.25  # [turns]


class Stiffness(JointEffect):
    r"""
    A spring pulls the joint to its rest position.

    .. math:: \tau = -\min(k,\; I / h^2)\,(q - q_0)

    The bound is the stiffness whose oscillation a sub-step :math:`h` can just resolve (:math:`I` is
    the joint's effective inertia); beyond it the derivative by :math:`k` is zero. Full turns count:
    the position is not wrapped. Without a spring, :math:`q_0` has no derivative.

    Source: Rao, *Mechanical Vibrations*, Prentice Hall 2011, section 1.7 (spring elements).
    """

    uses_load = False
    name = "stiffness"
    parameters = {
        "k": Parameter(null=0.0, scale=0.2, unit="N m/rad", lower=0.0),
        "q0": Parameter(null=0.0, scale=0.2, unit="rad"),
    }
    explanation = "Something elastic, such as a cable or a hose, pulls the joint to one position."
    source = "Rao 2011, section 1.7"
    blended = "q0"
    equivalents = {
        "constant_force": "where the joint hardly moves",
        "parameter.gravity": "where a joint under gravity swings but little",
    }

    def grid(self, ranges: Ranges) -> tuple[dict[str, float], ...]:
        return {"q0": -ranges.excursion}, {"q0": ranges.excursion}

    def blend(
        self, sizes: tuple[float, float], settings: tuple[Mapping[str, float], Mapping[str, float]]
    ) -> dict[str, float]:
        k = sum(sizes)
        moment = sum(size * at["q0"] for size, at in zip(sizes, settings, strict=True))
        return {"k": k, "q0": moment / k if k else 0.0}

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        k = jnp.minimum(params["k"], joint.inertia / joint.h**2)
        return -k * (joint.q - params["q0"])


class CubicStiffness(JointEffect):
    r"""
    A hardening spring at zero: weak near zero, and strong far from it.

    .. math:: \tau = -\min(k_3\,q^2,\; I / h^2)\,q

    The bound is that of :class:`Stiffness`. Softening springs are excluded: alone, they are
    unstable.

    Source: Kovacic and Brennan, *The Duffing Equation*, Wiley 2011, chapter 2.
    """

    uses_load = False
    name = "cubic_stiffness"
    parameters = {"k3": Parameter(null=0.0, scale=0.05, unit="N m/rad3", lower=0.0)}
    explanation = "Something elastic resists large deflections much more than small ones."
    source = "Kovacic and Brennan 2011, chapter 2"

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        return -jnp.minimum(params["k3"] * joint.q**2, joint.inertia / joint.h**2) * joint.q


class Cogging(JointEffect):
    r"""
    The joint snaps to equally spaced positions, as a motor with magnets and slots does.

    .. math:: \tau = -\min\!\Big(A,\; \frac{\lambda I}{2 \pi h^2}\Big)
              \sin\frac{2 \pi\,(q - \varphi)}{\lambda}

    It rests at :math:`q = \varphi`, and at every period :math:`\lambda` from there, both in the
    unit of the joint. The bound is that of :class:`Stiffness` at the largest slope. At zero
    amplitude, period and phase have no derivative, and a local search for the period ends in the
    nearest local optimum.

    Source: *MuJoCo DC motor model*, Google DeepMind 2026, section 1.2 (its phase is
    :math:`\pi - 2 \pi \varphi / \lambda`).
    """

    uses_load = False
    name = "cogging"
    parameters = {
        "amplitude": Parameter(null=0.0, scale=0.1, unit="N m", lower=0.0),
        # One sixth of a turn: the longest period of common motors.
        "period": Parameter(null=math.pi / 3.0, scale=0.2, unit="rad", lower=1e-9),
        "phase": Parameter(null=0.0, scale=0.2, unit="rad"),
    }
    explanation = "The joint snaps to equally spaced positions, as motors with magnets do."
    source = "MuJoCo DC motor model 2026, section 1.2"
    blended = "phase"

    def starts(self, excursion: float, speed: float) -> tuple[dict[str, float], ...]:
        periods = [excursion / n for n in _CYCLES]
        return tuple({"period": x, "phase": phase * x} for x in periods for phase in _PHASES)

    def grid(self, ranges: Ranges) -> tuple[dict[str, float], ...]:
        longest = min(0.5 * ranges.excursion, _LONGEST * ranges.turn)
        periods = [longest / n for n in _DIVISORS if longest > 0.0]
        return tuple({"period": x, "phase": phase * x} for x in periods for phase in _PHASES[:2])

    def blend(
        self, sizes: tuple[float, float], settings: tuple[Mapping[str, float], Mapping[str, float]]
    ) -> dict[str, float]:
        period, phase = settings[0]["period"], settings[0]["phase"]
        ahead = period * math.atan2(sizes[1], sizes[0]) / (2.0 * math.pi)
        return {"amplitude": math.hypot(*sizes), "period": period, "phase": phase + ahead}

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        per_period = 2.0 * math.pi / params["period"]
        steepest = joint.inertia / (joint.h**2 * per_period)
        amplitude = jnp.minimum(params["amplitude"], steepest)
        return -amplitude * jnp.sin(per_period * (joint.q - params["phase"]))


class ConstantForce(JointEffect):
    r"""
    The same force at all times and positions.

    .. math:: \tau = \tau_0

    An eccentric mass at a horizontal hinge is not such a force: its torque varies with the angle.

    Source: Janot, Gautier and Brunot, *Data set and reference models of EMPS*, Workshop on
    Nonlinear System Identification Benchmarks, 2019 (the offset).
    """

    uses_load = False
    name = "constant_force"
    parameters = {"tau_0": Parameter(null=0.0, scale=0.1, unit="N m")}
    explanation = "Something pushes the joint the same way all the time, as an offset of its drive."
    source = "Janot, Gautier and Brunot 2019"
    equivalents = {
        "coulomb_friction": "while the joint moves in one direction",
        "directional_coulomb_friction": "together with a coulomb_friction, while the joint moves",
        "stiffness": "where the joint hardly moves",
        "parameter.gravity_x": "at a slider, or where a hinge hardly turns",
        "parameter.tilt": "where a hinge hardly turns",
        "parameter.tilt_x": "where the arm that carries a pendulum hardly turns",
        "parameter.tilt_y": "where the arm that carries a pendulum hardly turns",
    }

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        return jnp.asarray(params["tau_0"], joint.q.dtype)
