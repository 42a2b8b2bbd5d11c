"""Twins of model files: against MuJoCo's own steps, and in what they read, refuse and derive."""

import dataclasses
import functools
import json
import os
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import small_robots as robots
from jax.flatten_util import ravel_pytree

from sb3_hds import twins
from sb3_hds.core import State, rollout
from sb3_hds.errors import ModelFileError, ParameterError

pytestmark = pytest.mark.usefixtures("quick_compilation", "x64")

GYMNASIUM = os.path.join(os.path.dirname(gymnasium.__file__), "envs/mujoco/assets")
OFF = mujoco.mjtDisableBit
# What a twin leaves out, where it is told to.
NOTHING_TOUCHES = int(OFF.mjDSBL_CONTACT) | int(OFF.mjDSBL_LIMIT)
INTEGRATORS = {"euler": 0, "rk4": 1, "implicitfast": 3}


def shipped(name):
    model = mujoco.MjModel.from_xml_path(os.path.join(GYMNASIUM, name))
    model.opt.disableflags |= NOTHING_TOUCHES
    return model


MODELS = {
    "reacher": lambda: shipped("reacher.xml"),
    "half cheetah": lambda: shipped("half_cheetah.xml"),
    "cart-pole": lambda: robots.compiled(robots.CART_POLE),
    "gripper": lambda: robots.compiled(robots.GRIPPER),
    "ball joint": lambda: robots.compiled(robots.BALL),
    "arm of 6 servos": lambda: robots.compiled(robots.chain(6, actuator="position")),
    "arm of 7 motors": lambda: robots.compiled(robots.chain(7)),
    "arm of 3 speeds": lambda: robots.compiled(robots.chain(3, actuator="velocity")),
    "held quadruped": lambda: robots.compiled(robots.quadruped()),
    "free quadruped": lambda: robots.compiled(robots.quadruped(robots.FREE_BASE)),
}
# The others run now and then: what differs is the program of every pair.
QUICK = {
    ("reacher", "rk4"),
    ("cart-pole", "rk4"),
    ("gripper", "implicitfast"),
    ("ball joint", "euler"),
    ("arm of 6 servos", "implicitfast"),
    ("arm of 3 speeds", "implicitfast"),
    ("held quadruped", "euler"),
}


def commands_for(model, n, seed=0):
    """Random, and beyond their limits now and then."""
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, (-1, 1)).T
    return np.random.default_rng(seed).uniform(1.2 * low, 1.2 * high, (n, model.nu))


def start_of(model, seed=0):
    """Somewhere, in motion."""
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 0.5)
    data.qvel[:] = rng.normal(size=model.nv)
    return data


@functools.partial(jax.jit, static_argnums=0)
def simulated(twin, params, q, v, actions):
    states = rollout(twin, params, State(q, v, {}), actions).states
    return states.q, states.v


def assert_follows(twin, model, n=200, seed=0, tolerance=1e-12):
    data, actions = start_of(model, seed), commands_for(model, n, seed)
    q, v = simulated(twin, twin.params, jnp.array(data.qpos), jnp.array(data.qvel), actions)
    for k, action in enumerate(actions):
        data.ctrl[:] = action
        mujoco.mj_step(model, data)
        theirs, ours = np.r_[data.qpos, data.qvel], np.r_[q[k + 1], v[k + 1]]
        # Rounding of 1e-16 per operation, grown along 200 steps.
        np.testing.assert_allclose(ours, theirs, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(
    ("name", "integrator"),
    [
        pytest.param(
            name,
            integrator,
            marks=[] if (name, integrator) in QUICK else pytest.mark.expensive,
        )
        for name in MODELS
        for integrator in INTEGRATORS
    ],
)
def test_a_twin_steps_as_mujoco_does(name, integrator):
    model = MODELS[name]()
    model.opt.integrator = INTEGRATORS[integrator]

    assert_follows(twins.from_mujoco(model), model)


def with_(model, **changes):
    """:return: a compiled model with other numbers, by field"""
    changed = mujoco.MjModel.from_xml_string(model) if isinstance(model, str) else model
    for name, change in changes.items():
        getattr(changed, name)[:] = change(getattr(changed, name))
    return changed
