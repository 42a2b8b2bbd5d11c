"""Transmissions between a motor and its load, which split a joint's inertia in two."""

import abc
from typing import TYPE_CHECKING

import jax.numpy as jnp

from sb3_hds.core import ForceEffect, Moment, Parameter, solve_spd
from sb3_hds.core.types import Force, Memory, Params, Scalar
from sb3_hds.effects.shapes import beyond
from sb3_hds.errors import EffectError

if TYPE_CHECKING:
    from sb3_hds.core import Twin

# Default share of a joint's inertia that turns with the motor: gears are commonly chosen so that
# the motor's reflected inertia equals the load's.
_MATCHED = 0.5


class Transmission(ForceEffect):
    r"""
    Abstract: a motor that moves relative to its load, where the twin has one rigid joint.

    The share :math:`\sigma` of the joint's inertia :math:`I` belongs to the motor. With the lead
    :math:`\delta` of the motor over the load (whose position is that of the joint), and the torque
    :math:`s` between the two,

    .. math::
        \sigma (1 - \sigma) I\,\ddot\delta = \tau_\text{act} - \sigma I \dot v_\text{rigid} - s,
        \qquad \tau = -\sigma I\,\ddot\delta

    where :math:`\dot v_\text{rigid}` is the acceleration of the twin without effects. The force
    :math:`\tau` on the joint is the reaction to the motor's own motion, so the total momentum is
    that of the rigid joint. Forces of other effects act on both sides in proportion to their
    inertia. If the joint's inertia depends on the position of other joints, so does the motor's.

    The memory is :math:`\delta` and its speed; both are zero at the start of an episode.
    """

    held = True
    options = ("motor_share",)

    def __init__(
        self, where: int | str = 0, *, motor_share: float = _MATCHED, **values: float
    ) -> None:
        super().__init__(where, **values)
        if not 0.0 < motor_share < 1.0:
            raise EffectError(
                f"motor_share is the share of the joint's inertia that turns with the motor: "
                f"between 0 and 1, both excluded, got {motor_share}."
            )
        self.motor_share = float(motor_share)

    @abc.abstractmethod
    def lead(
        self, memory: Memory, drive: Scalar, inertia: Scalar, h: float, params: Params
    ) -> Memory:
        """
        :param memory: ``lead`` [rad] and its ``speed`` [rad/s] at the start of a sub-step
        :param drive: torque that turns the motor against the load, without :math:`s` [N m]
        :param inertia: of the relative motion [kg m2]
        :param h: length of the sub-step [s]
        :return: the memory at the end of the sub-step
        """

    def memory(self, twin: "Twin") -> Memory:
        return {"lead": jnp.zeros(()), "speed": jnp.zeros(())}

    def force(self, moment: Moment, index: int, memory: Memory, params: Params) -> Force:
        inertia, _ = self._relative_motion(moment, index)
        after = self.advance(moment, index, memory, params)
        torque = self.motor_share * inertia * (memory["speed"] - after["speed"]) / moment.h
        return jnp.zeros_like(moment.v).at[index].set(torque)

    def advance(self, moment: Moment, index: int, memory: Memory, params: Params) -> Memory:
        inertia, drive = self._relative_motion(moment, index)
        share = self.motor_share
        return self.lead(memory, drive, share * (1.0 - share) * inertia, moment.h, params)

    def _relative_motion(self, moment: Moment, index: int) -> tuple[Scalar, Scalar]:
        """The joint's effective inertia, and the torque that turns the motor against the load."""
        unit = jnp.zeros_like(moment.v).at[index].set(1.0)
        forces = jnp.stack([unit, moment.actuator - moment.load], -1)
        by_unit, rigid = solve_spd(moment.mass_matrix, forces)[index]
        inertia = 1.0 / by_unit
        return inertia, moment.actuator[index] - self.motor_share * inertia * rigid


class JointElasticity(Transmission):
    r"""
    A spring between motor and load, as in a belt, a long shaft or a harmonic drive.

    .. math:: s = k\,\delta + d\,\dot\delta, \qquad
              \omega_r^2 = \frac{k}{\sigma (1 - \sigma) I}

    with :math:`\delta, \sigma, I` of :class:`~sb3_hds.effects.transmission.Transmission`, and the
    resonance frequency :math:`\omega_r` of motor against load. The relative motion is integrated by
    the implicit midpoint rule, which is stable at any sub-step: if :math:`\omega_r h \gg 1`, the
    frequency is not resolved, but the energy does not grow.

    :math:`k = 0` stands for a rigid joint, because every effect is absent at its null. The effect
    therefore jumps at zero, and the smallest :math:`k` is the softest joint. At zero there is no
    derivative, and a search must start at a positive stiffness. A :math:`d` without :math:`k` has
    no effect. The resonance determines only one combination of :math:`k` and :math:`\sigma`.

    Source: De Luca and Book, *Robots with flexible elements*, Springer Handbook of Robotics 2008,
    section 13.1.1; Spong, *Modeling and control of elastic joint robots*, Journal of Dynamic
    Systems, Measurement, and Control 109(4), 1987.

    :param motor_share: option; :math:`\sigma`, share of the joint's inertia that turns with the
        motor
    :raises EffectError: unless it lies between 0 and 1
    """

    name = "joint_elasticity"
    parameters = {
        "k": Parameter(null=0.0, scale=20.0, unit="N m/rad", lower=0.0),
        "d": Parameter(null=0.0, scale=0.1, unit="N m s/rad", lower=0.0),
    }
    explanation = "The drive is springy: its motor can turn a little before the load follows."
    source = "De Luca and Book 2008, section 13.1.1"
    forgets = 5.0

    def lead(
        self, memory: Memory, drive: Scalar, inertia: Scalar, h: float, params: Params
    ) -> Memory:
        k, d, momentum = params["k"], params["d"], 2.0 * inertia / h
        pull = momentum * memory["speed"] + drive - k * memory["lead"]
        halfway = jnp.where(k > 0.0, pull / (momentum + d + 0.5 * k * h), 0.0)
        return {"lead": memory["lead"] + h * halfway, "speed": 2.0 * halfway - memory["speed"]}


class Backlash(Transmission):
    r"""
    Play between motor and load, as between the teeth of a worn gear.

    .. math:: |\delta| \le g / 2, \qquad
              s = 0 \ \text{ inside the gap}

    with :math:`\delta` of :class:`~sb3_hds.effects.transmission.Transmission`. At the ends of the
    gap motor and load move together, as the rigid joint does; they meet without rebound, so energy
    is lost and never gained (Moreau's time stepping: first order in the sub-step). Elastic or
    bouncing teeth are not simulated. An episode starts in the middle of the gap.

    Source: Nordin and Gutman, *Controlling mechanical systems with backlash: a survey*, Automatica
    38(10), 2002, section 2.

    :param motor_share: option; share of the joint's inertia that turns with the motor
    :raises EffectError: unless it lies between 0 and 1
    """

    name = "backlash"
    parameters = {"gap": Parameter(null=0.0, scale=0.02, unit="rad", lower=0.0)}
    explanation = "The drive has play: when it turns round, it moves before the load does."
    source = "Nordin and Gutman 2002, section 2"

    def lead(
        self, memory: Memory, drive: Scalar, inertia: Scalar, h: float, params: Params
    ) -> Memory:
        speed = memory["speed"] + h * drive / inertia
        lead = memory["lead"] + h * speed
        too_far = beyond(lead, 0.5 * params["gap"])
        return {"lead": lead - too_far, "speed": speed - too_far / h}
