"""Forces that no diagnosis names: what is named has to predict better than these do."""

from typing import TYPE_CHECKING

import jax.numpy as jnp

from sb3_hds.core import JointEffect, JointMoment, Memory, Moment, Parameter, Params, Scalar

if TYPE_CHECKING:
    from sb3_hds.core import Twin

# Where springs may begin on both sides, where stops may be on one side, and how far friction may
# yield: in shares of the excursion.
_SLACKS, _STOPS, _SLIPS = (
    (0.1, 0.2, 0.3, 0.45, 0.6),
    (-0.2, -0.05, 0.1, 0.25, 0.4),
    (0.03, 0.08, 0.2, 0.4),
)
# An edge that no joint reaches [rad] or [m].
_NEVER = 1e3


class ClearanceSpring(JointEffect):
    r"""
    A spring that acts only outside of its clearance: a stop, or a cable that is slack in between.

    .. math::
        \tau = -\min\!\Big(k,\; \frac{I}{h^2}\Big)
               \Big(\max(q - q_\text{high}, 0) + \min(q - q_\text{low}, 0)\Big)

    The bound is the same as that of :class:`Stiffness`. With both edges at zero it is a spring; an
    edge that the joint never reaches leaves a stop on the other side.

    Source: Shaw and Holmes, *A periodically forced piecewise linear oscillator*, Journal of Sound
    and Vibration 90(1), 1983.
    """

    name = "clearance_spring"
    parameters = {
        "k": Parameter(null=0.0, scale=0.5, unit="N m/rad", lower=0.0),
        "low": Parameter(null=0.0, scale=0.2, unit="rad"),
        "high": Parameter(null=0.0, scale=0.2, unit="rad"),
    }
    explanation = "A spring acts beyond an edge only, as a stop or a slack cable does."
    source = "Shaw and Holmes 1983"

    def starts(self, excursion: float, speed: float) -> tuple[dict[str, float], ...]:
        both = [{"low": -s * excursion, "high": s * excursion} for s in _SLACKS]
        above = [{"low": -_NEVER, "high": s * excursion} for s in _STOPS]
        below = [{"low": -s * excursion, "high": _NEVER} for s in _STOPS]
        return (*both, *above, *below)

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        above = jnp.maximum(joint.q - params["high"], 0.0)
        below = jnp.minimum(joint.q - params["low"], 0.0)
        return -jnp.minimum(params["k"], joint.inertia / joint.h**2) * (above + below)


class ElastoplasticFriction(JointEffect):
    r"""
    Dry friction that yields like a spring before it slides: hysteresis.

    .. math::
        \tau = -\min\!\Big(\frac{\tau_c}{s},\; \frac{I}{h^2}\Big)\, z, \qquad
        \dot z = v \ \text{ within } |z| \le s

    with the travel :math:`s` after which it slides. An episode starts with :math:`z = 0`.

    Source: Prandtl's element, as in Dupont et al., *Single state elastoplastic friction models*,
    IEEE Transactions on Automatic Control 47(5), 2002, section II.
    """

    name = "elastoplastic_friction"
    parameters = {
        "tau_c": Parameter(null=0.0, scale=0.1, unit="N m", lower=0.0),
        "slip": Parameter(null=0.1, scale=0.05, unit="rad", lower=1e-3),
    }
    explanation = "Friction yields like a spring before the joint slides."
    source = "Dupont et al. 2002, section II"
    forgets = 2.0

    def starts(self, excursion: float, speed: float) -> tuple[dict[str, float], ...]:
        return tuple({"slip": share * excursion} for share in _SLIPS)

    def memory(self, twin: "Twin") -> Memory:
        return jnp.zeros(())

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        slip = params["slip"]
        stiffness = jnp.minimum(params["tau_c"] / slip, joint.inertia / joint.h**2)
        return -stiffness * jnp.clip(memory, -slip, slip)

    def advance(self, moment: Moment, index: int, memory: Memory, params: Params) -> Memory:
        return jnp.clip(memory + moment.h * moment.v[index], -params["slip"], params["slip"])
