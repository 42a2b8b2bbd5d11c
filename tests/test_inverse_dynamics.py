"""Parameters from forces: where a simulation under wrong values runs away, and what it refuses."""

import jax.numpy as jnp
import numpy as np
import pytest

from sb3_hds import Trajectories, effects, twins
from sb3_hds.errors import CalibrationError
from sb3_hds.sysid import calibrate

LIGHT = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody><body name="a"><joint name="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.01" mass="0.02"/></body></worldbody>
  <actuator><motor name="m" joint="hinge"/></actuator></mujoco>"""
TRUE = {"hinge_damping": 0.8, "hinge_frictionloss": 0.5}


def driven(n=600, noise=0.05, seed=0):
    """A light joint whose friction takes all of the torque, which is logged with its noise."""
    rng, dt = np.random.default_rng(seed), 0.008
    t = np.arange(n + 1) * dt
    q = 0.5 * np.sin(2.0 * t) + 0.2 * np.sin(5.0 * t + 1.0)
    v = np.cos(2.0 * t) + np.cos(5.0 * t + 1.0)
    a = -2.0 * np.sin(2.0 * t) - 5.0 * np.sin(5.0 * t + 1.0)
    twin = twins.from_mujoco(LIGHT)
    inertia = float(twin.mass_matrix(jnp.zeros(1), twin.params)[0, 0])
    weight = 0.02 * 9.81 * 0.1 * np.sin(q)
    torque = inertia * a + weight + 0.8 * v + 0.5 * np.tanh(v / 0.01)
    torque = torque + noise * rng.standard_normal(n + 1)
    obs = np.stack([q, v], 1) + 1e-4 * rng.standard_normal((n + 1, 2))
    return Trajectories.from_arrays([obs], [torque[:-1, None]], dt=dt)


def test_friction_that_takes_all_of_the_torque_is_found_from_forces():
    twin = twins.from_mujoco(LIGHT, dt=0.008)

    fit = calibrate(twin, driven(), free=list(TRUE), errors="force")

    for name, value in TRUE.items():
        assert fit[name].estimate == pytest.approx(value, rel=0.1)
        assert 0.0 < fit[name].stderr < 0.2 * value
    assert fit.errors == "force" and "to the forces of 11 windows" in str(fit)
    assert np.all(fit.error_after < 0.1 * fit.error_before)


def test_a_simulation_that_runs_away_begins_where_forces_lead():
    """From zero friction, simulated velocities are hundreds of times the measured ones."""
    twin = twins.from_mujoco(LIGHT, dt=0.008)
    fit = calibrate(twin, driven(n=120, noise=0.0), free=list(TRUE), window=10)
    for name, value in TRUE.items():
        assert fit[name].estimate == pytest.approx(value, rel=0.1)


def test_forces_of_a_twin_with_effects_are_refused():
    twin = twins.from_mujoco(LIGHT, dt=0.008).extend(effects.ActionDelay(0))

    with pytest.raises(CalibrationError, match="Calibrate the twin without effects"):
        calibrate(twin, driven(), free=list(TRUE), errors="force")
    with pytest.raises(CalibrationError, match="errors must be 'simulation' or 'force', got 'x'"):
        calibrate(twin, driven(), errors="x")
