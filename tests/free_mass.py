"""A free mass on a rail: the simplest twin, for which the physics of an effect is known exactly."""

import jax
import jax.numpy as jnp
import numpy as np

from sb3_hds.core import Actuator, AnalyticTwin, Channel, Joint, Parameter, State, rollout


class Mass(AnalyticTwin):
    """A free mass on a rail, driven by a force; its own damping is a parameter."""

    name = "Mass"
    dt = 0.1
    joints = (Joint("rail", "m"),)
    actuators = (Actuator("push", "N", -10.0, 10.0),)
    channels = (Channel("position", "m"), Channel("speed", "m/s"))
    parameters = {
        "mass": Parameter(null=1.0, scale=0.1, unit="kg", lower=0.1),
        "damping": Parameter(null=0.0, scale=0.1, unit="N s/m", lower=0.0),
    }

    def initial(self, key, params):
        return State(jnp.zeros(1), jax.random.normal(key, (1,)), {})

    def infer(self, obs, params):
        return State(obs[:1], obs[1:], {})

    def observe(self, state, params):
        return jnp.concatenate([state.q, state.v])

    def actuate(self, state, action, params):
        return jnp.clip(action, -10.0, 10.0)

    def mass_matrix(self, q, params):
        return params["mass"] * jnp.ones((1, 1), q.dtype)

    def bias(self, q, v, params):
        return params["damping"] * v


def mass_with(integrator, **settings):
    """:return: a mass that is stepped by this integrator"""

    class Integrated(Mass):
        pass

    Integrated.integrator = staticmethod(integrator)
    return Integrated(**settings)


def moved(twin, pushes, position=0.0, speed=0.0):
    """:return: the rollout of a mass under these forces [N], one for each control interval"""
    start = twin.infer(jnp.array([position, speed]), twin.params)
    return rollout(twin, twin.params, start, jnp.asarray(np.asarray(pushes, float))[:, None])
