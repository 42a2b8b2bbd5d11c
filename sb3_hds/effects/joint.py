"""Forces at a joint."""

import jax.numpy as jnp

from sb3_hds.core import JointEffect, JointMoment, Memory, Parameter, Params, Scalar

# Speed below which dry friction is smoothed [rad/s] or [m/s]: true friction jumps at standstill.
_STANDSTILL = 0.01


class ViscousFriction(JointEffect):
    r"""
    Friction that grows with speed.

    .. math:: \tau = -\min(b,\; I / h)\,v

    The bound is the coefficient that stops the joint within one sub-step :math:`h` (:math:`I` is
    its effective inertia); beyond it an explicit integrator would turn friction into a drive. There
    the derivative with respect to :math:`b` is zero.

    Source: Olsson et al., *Friction models and friction compensation*, European Journal of Control
    4(3), 1998, section 2.
    """

    name = "viscous_friction"
    parameters = {"b": Parameter(null=0.0, scale=0.05, unit="N m s/rad", lower=0.0)}
    explanation = (
        "The joint resists motion in proportion to its speed, as a lubricated bearing does."
    )
    source = "Olsson et al. 1998, section 2"

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        return -jnp.minimum(params["b"], joint.inertia / joint.h) * joint.v


class CoulombFriction(JointEffect):
    r"""
    Dry friction: opposes motion with a force that does not depend on speed.

    .. math:: \tau = -\tau_c \tanh(v / w), \qquad w = \max(0.01\ \mathrm{rad/s},\; \tau_c h / I)

    The sign function is smoothed over :math:`w`, which never falls below what a sub-step :math:`h`
    can stop (:math:`I` is the joint's effective inertia): so friction at one joint does not
    overshoot standstill at any step length. What this costs: a joint never sticks; under a load
    :math:`f < \tau_c` it creeps at :math:`w\,\mathrm{artanh}(f / \tau_c)` instead. Dry friction at
    several strongly coupled joints at once may chatter around standstill if :math:`h` is long.

    Source: Olsson et al., *Friction models and friction compensation*, European Journal of Control
    4(3), 1998, section 2.
    """

    name = "coulomb_friction"
    parameters = {"tau_c": Parameter(null=0.0, scale=0.1, unit="N m", lower=0.0)}
    explanation = (
        "The joint resists motion with a force that does not depend on speed, as dry surfaces do."
    )
    source = "Olsson et al. 1998, section 2"

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        width = jnp.maximum(_STANDSTILL, params["tau_c"] * joint.h / joint.inertia)
        return -params["tau_c"] * jnp.tanh(joint.v / width)


class QuadraticDrag(JointEffect):
    r"""
    Resistance of a medium: grows with the square of the speed.

    .. math:: \tau = -\min(c\,|v|,\; I / h)\,v

    The bound is the same as that of :class:`ViscousFriction`.

    Source: Fossen, *Handbook of Marine Craft Hydrodynamics and Motion Control*, Wiley 2011,
    section 6.4.
    """

    name = "quadratic_drag"
    parameters = {"c": Parameter(null=0.0, scale=0.02, unit="N m s2/rad2", lower=0.0)}
    explanation = "The joint moves through a medium, such as air, that resists fast motion most."
    source = "Fossen 2011, section 6.4"

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        return -jnp.minimum(params["c"] * jnp.abs(joint.v), joint.inertia / joint.h) * joint.v
