"""Friction and drag at a joint."""

import math

import jax.numpy as jnp
import numpy as np

from sb3_hds.core import JointEffect, JointMoment, Memory, Parameter, Params, Ranges, Scalar
from sb3_hds.effects.shapes import STANDSTILL, dry_friction
from sb3_hds.errors import EffectError

# Null of the speed at which a friction curve bends, in units of the smoothed speed.
_BEND = 10.0
# Initial values of a search for the Stribeck speed, as shares of the speed of the motion.
_SHARES = (0.03, 0.1, 0.3, 1.0)
# Range of the speed at which concave friction bends, as shares of the speed of the motion, and the
# number of values at which equation errors are evaluated.
_BENDS, _STEPS = (0.2, 1.0), 8


def _bend(standstill: float = STANDSTILL) -> Parameter:
    """The speed at which a friction curve bends; it is visible only above the smoothed range."""
    speed = _BEND * standstill
    return Parameter(null=speed, scale=speed, unit="rad/s", lower=standstill)


class ViscousFriction(JointEffect):
    r"""
    Friction that grows with speed.

    .. math:: \tau = -\min(b,\; I / h)\,v

    The bound is the coefficient that stops the joint within one sub-step :math:`h` (:math:`I` is
    its effective inertia); with larger ones an explicit integrator is unstable. Beyond the bound
    the derivative by :math:`b` is zero.

    Source: Olsson et al., *Friction models and friction compensation*, European Journal of Control
    4(3), 1998, section 2.
    """

    uses_load = False
    name = "viscous_friction"
    parameters = {"b": Parameter(null=0.0, scale=0.05, unit="N m s/rad", lower=0.0)}
    explanation = (
        "The joint resists motion in proportion to its speed, as a lubricated bearing does."
    )
    source = "Olsson et al. 1998, section 2"
    equivalents = {
        "directional_viscous_friction": "while the joint moves in one direction",
        "concave_friction": "while the joint moves several times slower than v_s",
    }

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        return -jnp.minimum(params["b"], joint.inertia / joint.h) * joint.v


class DirectionalViscousFriction(JointEffect):
    r"""
    Friction that grows with speed, with a different coefficient for each direction.

    .. math::
        \tau = -\min(b,\; I / h)\,v, \qquad
        b = \begin{cases} b_+ & v > 0 \\ b_- & v \le 0 \end{cases}

    The bound is that of :class:`ViscousFriction`. The derivative by the coefficient of the other
    direction is zero.

    Source: Olsson et al., *Friction models and friction compensation*, European Journal of Control
    4(3), 1998, section 2 (curves of friction over speed need not be symmetrical).
    """

    uses_load = False
    name = "directional_viscous_friction"
    parameters = {
        "b_pos": Parameter(null=0.0, scale=0.05, unit="N m s/rad", lower=0.0),
        "b_neg": Parameter(null=0.0, scale=0.05, unit="N m s/rad", lower=0.0),
    }
    explanation = (
        "The joint resists motion in proportion to its speed, one way more than the other."
    )
    source = "Olsson et al. 1998, section 2"
    equivalents = {"viscous_friction": "while the joint moves in one direction"}

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        b = jnp.where(joint.v > 0.0, params["b_pos"], params["b_neg"])
        return -jnp.minimum(b, joint.inertia / joint.h) * joint.v


class DryFriction(JointEffect):
    """
    Abstract: a force against the motion that jumps at standstill, smoothed for simulation.

    :param standstill: option; speed below which it is smoothed [rad/s] or [m/s]
    :raises EffectError: unless that is positive
    """

    uses_load = False
    options = ("standstill",)

    def __init__(
        self, where: int | str = 0, *, standstill: float = STANDSTILL, **values: float
    ) -> None:
        if not (isinstance(standstill, int | float) and 0.0 < standstill < math.inf):
            raise EffectError(f"standstill is a positive speed, got {standstill!r}.")
        self.standstill = float(standstill)
        if "v_s" in self.parameters:
            self.parameters = {**self.parameters, "v_s": _bend(standstill)}  # type: ignore[misc]
        super().__init__(where, **values)

    def against(self, joint: JointMoment, level: Scalar | float) -> Scalar:
        """:return: a force of this size against the motion"""
        return dry_friction(joint, level, self.standstill)


class CoulombFriction(DryFriction):
    r"""
    Dry friction: opposes motion with a force that does not depend on speed.

    .. math:: \tau = -\tau_c \tanh(v / w), \qquad w = \max(w_0,\; \tau_c h / I)

    The sign function is smoothed over :math:`w`: at least :math:`w_0`, the option ``standstill``,
    and at least the speed that a sub-step :math:`h` can stop (:math:`I` is the joint's effective
    inertia), so that friction at one joint never overshoots standstill. The cost: a joint never
    sticks; under a load :math:`f < \tau_c` it creeps at :math:`w\,\mathrm{artanh}(f / \tau_c)`.
    Dry friction at several strongly coupled joints may chatter around standstill if :math:`h` is
    long.

    Source: Olsson et al., *Friction models and friction compensation*, European Journal of Control
    4(3), 1998, section 2.
    """

    name = "coulomb_friction"
    parameters = {"tau_c": Parameter(null=0.0, scale=0.1, unit="N m", lower=0.0)}
    explanation = (
        "The joint resists motion with a force that does not depend on speed, as dry surfaces do."
    )
    source = "Olsson et al. 1998, section 2"
    equivalents = {
        "directional_coulomb_friction": "while the joint moves in one direction",
        "concave_friction": "while the joint moves several times faster than v_s",
        "stribeck_friction": "while the joint moves several times faster than v_s",
        "load_dependent_friction": "where the joint transmits the same force all the time",
        "constant_force": "while the joint moves in one direction",
        "dead_zone": "while the joint moves the way it is driven",
    }

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        return self.against(joint, params["tau_c"])


class DirectionalCoulombFriction(DryFriction):
    r"""
    Dry friction that is stronger in one direction than in the other.

    .. math::
        \tau = -\tau \tanh(v / w), \qquad
        \tau = \begin{cases} \tau_+ & v > 0 \\ \tau_- & v \le 0 \end{cases}

    Smoothed over :math:`w` as :class:`CoulombFriction` is. While the joint moves, it equals Coulomb
    friction of :math:`(\tau_+ + \tau_-) / 2` and a constant force of :math:`(\tau_- - \tau_+) / 2`;
    unlike a constant force, it vanishes at standstill.

    Source: Janot, Gautier and Brunot, *Data set and reference models of EMPS*, Workshop on
    Nonlinear System Identification Benchmarks, 2019 (there as Coulomb friction and an offset).
    """

    name = "directional_coulomb_friction"
    parameters = {
        "tau_pos": Parameter(null=0.0, scale=0.1, unit="N m", lower=0.0),
        "tau_neg": Parameter(null=0.0, scale=0.1, unit="N m", lower=0.0),
    }
    explanation = "The joint resists motion with a constant force, one way more than the other."
    source = "Janot, Gautier and Brunot 2019"
    equivalents = {
        "coulomb_friction": "together with a constant_force, while the joint moves",
        "constant_force": "together with a coulomb_friction, while the joint moves",
    }

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        return self.against(joint, jnp.where(joint.v > 0.0, params["tau_pos"], params["tau_neg"]))


class StribeckFriction(DryFriction):
    r"""
    Dry friction that decreases as the joint begins to move.

    .. math::
        \tau = -\Big(\tau_c + (\tau_s - \tau_c)\,e^{-(v / v_s)^2}\Big) \tanh(v / w)

    Smoothed over :math:`w` as :class:`CoulombFriction` is, so breakaway becomes a peak of friction
    at speeds between :math:`w` and :math:`v_s`; a :math:`v_s` below :math:`w` has no effect.
    Without friction, :math:`v_s` has no derivative. :math:`\tau_s < \tau_c` can be simulated, but a
    diagnosis does not report it.

    Source: Olsson et al., *Friction models and friction compensation*, European Journal of Control
    4(3), 1998, section 2 (exponent 2).
    """

    name = "stribeck_friction"
    parameters = {
        "tau_c": Parameter(null=0.0, scale=0.1, unit="N m", lower=0.0),
        "tau_s": Parameter(null=0.0, scale=0.15, unit="N m", lower=0.0),
        "v_s": _bend(),
    }
    explanation = "The joint resists most just as it begins to move, and less once it slides."
    source = "Olsson et al. 1998, section 2"
    equivalents = {"coulomb_friction": "while the joint moves several times faster than v_s"}
    ascending = ("tau_c", "tau_s")

    def starts(self, excursion: float, speed: float) -> tuple[dict[str, float], ...]:
        """Several widths of the peak: a narrow one has no gradient towards wider ones."""
        return tuple({"v_s": max(share * speed, self.standstill)} for share in _SHARES)

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        sticking = jnp.exp(-((joint.v / params["v_s"]) ** 2))
        level = params["tau_c"] + (params["tau_s"] - params["tau_c"]) * sticking
        return self.against(joint, level)


class ConcaveFriction(DryFriction):
    r"""
    Viscous friction whose slope decreases with speed, as in greased gears.

    .. math:: \tau = -\frac{b\,|v|}{1 + |v| / v_s} \tanh(v / w)

    Far below :math:`v_s` it is viscous friction of coefficient :math:`b`, far above it dry friction
    of :math:`b\,v_s`. It is smoothed around standstill as :class:`CoulombFriction` is. Without
    friction, :math:`v_s` has no derivative.

    Source: Waiboer, Aarts and Jonker, *Velocity dependence of joint friction in robotic
    manipulators with gear transmissions*, ECCOMAS Multibody Dynamics 2005 (friction of lubricated
    gears and bearings is concave over speed; the rational form is ours: two parameters, one of
    which is linear).
    """

    name = "concave_friction"
    parameters = {
        "b": Parameter(null=0.0, scale=0.05, unit="N m s/rad", lower=0.0),
        "v_s": _bend(),
    }
    explanation = "The joint resists motion the more the faster it is, but less than in proportion."
    source = "Waiboer et al. 2005"
    equivalents = {
        "viscous_friction": "while the joint moves several times slower than v_s",
        "coulomb_friction": "while the joint moves several times faster than v_s",
    }

    def starts(self, excursion: float, speed: float) -> tuple[dict[str, float], ...]:
        """Bends within the speeds of the motion: otherwise the friction is dry or viscous."""
        return tuple({"v_s": max(share * speed, self.standstill)} for share in _BENDS)

    def grid(self, ranges: Ranges) -> tuple[dict[str, float], ...]:
        shares = np.geomspace(*_BENDS, _STEPS)
        return tuple({"v_s": max(float(x) * ranges.speed, self.standstill)} for x in shares)

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        speed = jnp.abs(joint.v)
        return self.against(joint, params["b"] * speed / (1.0 + speed / params["v_s"]))


class LoadDependentFriction(DryFriction):
    r"""
    Dry friction that grows with the transmitted torque, as between the teeth of a gear.

    .. math::
        \tau = -(\tau_c + \mu\,|\tau_g|) \tanh(v / w), \qquad \tau_g = \tau_\text{act} + c(q, v)

    Here :math:`\tau_g` is the torque that presses the teeth together: that of the motor on one
    side, and that of gravity, Coriolis forces and the twin's own damping on the other. As
    :math:`M \dot v = \tau_\text{act} - c`, both add up when the motor holds its load:
    :math:`\tau_g` is then twice the motor's torque, as in the source. Torques of other effects are
    not included. Smoothed over :math:`w` as :class:`CoulombFriction` is.

    Source: Duclusaud et al., *Extended friction models for the physics simulation of servo
    actuators*, arXiv 2410.08650, 2024, model M3 (without its viscous friction).
    """

    uses_load = True
    name = "load_dependent_friction"
    parameters = {
        "tau_c": Parameter(null=0.0, scale=0.1, unit="N m", lower=0.0),
        "mu": Parameter(null=0.0, scale=0.1, unit="1", lower=0.0, upper=1.0),
    }
    explanation = "The joint resists motion the more, the more force it has to transmit."
    source = "Duclusaud et al. 2024, model M3"
    equivalents = {"coulomb_friction": "where the joint transmits the same force all the time"}

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        transmitted = joint.actuator + joint.load
        return self.against(joint, params["tau_c"] + params["mu"] * jnp.abs(transmitted))


class QuadraticDrag(JointEffect):
    r"""
    Resistance of a medium, which grows with the square of the speed.

    .. math:: \tau = -\min(c\,|v|,\; I / h)\,v

    The bound is that of :class:`ViscousFriction`.

    Source: Fossen, *Handbook of Marine Craft Hydrodynamics and Motion Control*, Wiley 2011,
    section 6.4.
    """

    uses_load = False
    name = "quadratic_drag"
    parameters = {"c": Parameter(null=0.0, scale=0.02, unit="N m s2/rad2", lower=0.0)}
    explanation = "The joint moves through a medium, such as air, that resists fast motion most."
    source = "Fossen 2011, section 6.4"

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        return -jnp.minimum(params["c"] * jnp.abs(joint.v), joint.inertia / joint.h) * joint.v
