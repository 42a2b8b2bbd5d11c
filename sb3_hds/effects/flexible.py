"""Flexible forces: a cause that a diagnosis names must predict better than these."""

from typing import TYPE_CHECKING

import jax.numpy as jnp

from sb3_hds.core import JointEffect, JointMoment, Memory, Moment, Parameter, Params, Scalar

if TYPE_CHECKING:
    from sb3_hds.core import Twin

# Initial values of a search, as shares of the excursion: half clearances, one-sided stops, and the
# deflections at which friction slides.
_SLACKS = (0.1, 0.2, 0.3, 0.45, 0.6)
_STOPS = (-0.2, -0.05, 0.1, 0.25, 0.4)
_SLIPS = (0.03, 0.08, 0.2, 0.4)
# Initial values of the exponent of hysteresis.
_EXPONENTS = (1.0, 4.0)
# Smallest deflection, as a share of the largest, whose power is computed.
_TINY = 1e-6
# An edge that no joint reaches [rad] or [m].
_NEVER = 1e3


class ClearanceSpring(JointEffect):
    r"""
    A spring that acts only outside its clearance: a stop, or a cable that is slack in between.

    .. math::
        \tau = -\min\!\Big(k,\; \frac{I}{h^2}\Big)
               \Big(\max(q - q_\text{high}, 0) + \min(q - q_\text{low}, 0)\Big)

    The bound is that of :class:`Stiffness`. With both edges at zero it is a spring; with one edge
    that the joint never reaches (a diagnosis takes 1000 rad) it is a stop on the other side.

    Source: Shaw and Holmes, *A periodically forced piecewise linear oscillator*, Journal of Sound
    and Vibration 90(1), 1983.
    """

    uses_load = False
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


class Hysteresis(JointEffect):
    r"""
    Dry friction with elastic deflection before sliding, as of bristles, rolling balls and cables.

    .. math::
        \tau = -\min\!\Big(\frac{\tau_c}{s},\; \frac{I}{h^2}\Big)\, z, \qquad
        \dot z = v \Big(1 - \operatorname{sign}(v z) \left|\frac{z}{s}\right|^n\Big)

    with the deflection :math:`s` at which it slides. :math:`n = 1` is Dahl's friction; a large
    :math:`n` is a spring in series with dry friction (Prandtl's element). An episode starts with
    :math:`z = 0`.

    Source: the Bouc-Wen model of Ikhouane and Rodellar, *Systems with Hysteresis*, Wiley 2007,
    chapter 2, without its hardening term.
    """

    uses_load = False
    name = "hysteresis"
    parameters = {
        "tau_c": Parameter(null=0.0, scale=0.1, unit="N m", lower=0.0),
        "slip": Parameter(null=0.1, scale=0.05, unit="rad", lower=1e-3),
        "n": Parameter(null=1.0, scale=0.5, unit="1", lower=0.5, upper=20.0),
    }
    explanation = "Friction yields like a spring before the joint slides."
    source = "Ikhouane and Rodellar 2007, chapter 2"
    forgets = 2.0

    def starts(self, excursion: float, speed: float) -> tuple[dict[str, float], ...]:
        return tuple({"slip": s * excursion, "n": n} for s in _SLIPS for n in _EXPONENTS)

    def memory(self, twin: "Twin") -> Memory:
        return jnp.zeros(())

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        stiffness = jnp.minimum(params["tau_c"] / params["slip"], joint.inertia / joint.h**2)
        return -stiffness * memory

    def advance(self, moment: Moment, index: int, memory: Memory, params: Params) -> Memory:
        change, slip = moment.h * moment.v[index], params["slip"]
        bent = jnp.maximum(jnp.abs(memory) / slip, _TINY) ** params["n"]
        after = memory + change * (1.0 - jnp.sign(change * memory) * bent)
        return jnp.clip(after, -slip, slip)
