"""The true twins of the environments that stand in for hardware."""

from typing import Any

from sb3_hds.core import Effect, Twin
from sb3_hds.effects import (
    ActionDelay,
    CoulombFriction,
    MotorLag,
    QuadraticDrag,
    TorqueGain,
    ViscousFriction,
)
from sb3_hds.envs.tasks.inverted_pendulum_friction import InvertedPendulumFriction
from sb3_hds.envs.tasks.pendulum_real import PendulumReal
from sb3_hds.twins import registry


def true_twin(env: Any) -> Twin:
    """
    The true twin of an environment that stands in for hardware, including its hidden effects: no
    model can be better. Sensor noise is not part of a twin.

    :param env: ``sb3_hds/PendulumReal-v1`` or ``sb3_hds/InvertedPendulumFriction-v5``, wrapped or
        not
    :return: its twin, extended by the effects that the environment has
    :raises TypeError: for another environment
    """
    bare = env.unwrapped
    if not isinstance(bare, PendulumReal | InvertedPendulumFriction):
        raise TypeError(
            "True twins are known for sb3_hds/PendulumReal-v1 and "
            f"sb3_hds/InvertedPendulumFriction-v5, not for {bare!r}. Build its twin yourself: "
            "twins.make(...).extend(...)."
        )
    twin = registry.from_env(env)
    hidden: list[tuple[float, float, Effect]]
    if isinstance(bare, PendulumReal):
        twin = twin.with_parameters(payload=bare.payload)
        hidden = [
            (bare.delay, 0.0, ActionDelay("torque", delay=bare.delay)),
            (bare.gain, 1.0, TorqueGain("torque", gain=bare.gain)),
            (bare.lag, 0.0, MotorLag("torque", time_constant=bare.lag)),
            (bare.friction, 0.0, CoulombFriction("hinge", tau_c=bare.friction)),
            (bare.drag, 0.0, QuadraticDrag("hinge", c=bare.drag)),
        ]
    else:
        hidden = [
            (bare.slider_damping, 0.0, ViscousFriction("slider", b=bare.slider_damping)),
            (bare.hinge_damping, 0.0, ViscousFriction("hinge", b=bare.hinge_damping)),
            (bare.slider_friction, 0.0, CoulombFriction("slider", tau_c=bare.slider_friction)),
            (bare.hinge_friction, 0.0, CoulombFriction("hinge", tau_c=bare.hinge_friction)),
        ]
    present = [effect for value, null, effect in hidden if value != null]
    return twin.extend(*present) if present else twin
