"""A leg of three joints whose servos take positions, with a late bus and dry friction."""

import jax
import jax.numpy as jnp
import numpy as np

from sb3_hds import Trajectories, effects, twins
from sb3_hds.core import rollout
from sb3_hds.twins import MechanismTwin

DT = 0.005  # [s]
_SERVO = '<position joint="{0}" kp="20" kv="1.5"/>'
_JOINTS = ("hip", "thigh", "calf")
XML = f"""<mujoco><option integrator="implicitfast" timestep="{DT}"/>
<default><geom contype="0" conaffinity="0" density="1000"/></default>
<worldbody><body pos="0 0 1"><joint name="hip" axis="1 0 0" armature="0.005"/>
<geom type="capsule" fromto="0 0 0 0 0.08 0" size="0.04"/>
<body pos="0 0.08 0"><joint name="thigh" axis="0 1 0" armature="0.005"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02"/>
<body pos="0 0 -0.2"><joint name="calf" axis="0 1 0" armature="0.005"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.012"/></body></body></body></worldbody>
<actuator>{"".join(map(_SERVO.format, _JOINTS))}</actuator></mujoco>"""


def leg() -> MechanismTwin:
    """:return: with positions observed, in steps of 5 ms"""
    return twins.from_mujoco(XML, dt=DT, observe="q")


def recorded(delay: float, friction: float, n: int = 6, steps: int = 400) -> Trajectories:
    """
    :param delay: of all targets [s]
    :param friction: dry, of each joint [N m]
    :return: measured positions under targets that swing ever faster
    """
    every = range(len(_JOINTS))
    late = (effects.ActionDelay(delay=delay).at(i) for i in every)
    rough = (effects.CoulombFriction(tau_c=friction).at(i) for i in every)
    real = leg().extend(*late, *rough)
    rng, t = np.random.default_rng(0), DT * np.arange(steps)
    phases = 2.0 * np.pi * (0.5 * t + 0.8 * t**2)[:, None] + rng.uniform(0.0, 6.0, (n, 1, 3))
    targets = rng.uniform(0.2, 0.5, (n, 1, 3)) * np.sin(phases)
    with jax.enable_x64(True):
        start = jax.vmap(lambda o: real.infer(o, real.params))(jnp.zeros((n, 3)))
        run = lambda s, a: rollout(real, real.params, s, a).states  # noqa: E731
        states = jax.vmap(run)(start, jnp.asarray(targets))
        seen = jax.vmap(jax.vmap(lambda s: real.observe(s, real.params)))(states)
    obs = np.asarray(seen) + 2e-4 * rng.standard_normal(seen.shape)
    return Trajectories.from_arrays(list(obs), list(targets), dt=DT)
