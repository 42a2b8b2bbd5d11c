"""Elasticity and play between motor and load, by the mechanics of two bodies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from free_mass import mass_with, moved
from scipy.integrate import solve_ivp

from sb3_hds import twins
from sb3_hds.core import State, rk4, rollout, semi_implicit_euler
from sb3_hds.effects import Backlash, JointElasticity
from sb3_hds.errors import EffectError

every_transmission = pytest.mark.parametrize(
    "effect", [JointElasticity(k=5.0, d=0.1), Backlash(gap=0.2)], ids=lambda effect: effect.name
)


def lead_of(states, key):
    memory = states.memory[key]
    return np.asarray(memory["lead"]), np.asarray(memory["speed"])


@each(
    (JointElasticity, "k", [1e-3, 1.0, 1e3, 1e9], 0.1, -2.0, semi_implicit_euler, 10.0),
    (JointElasticity, "k", [1e-3, 1.0, 1e3, 1e9], 0.1, -2.0, rk4, 1e-3),
    (Backlash, "gap", [1e-6, 0.1, 10.0], 0.0, 1.0, semi_implicit_euler, 10.0),
)
def test_neither_spring_nor_play_gains_energy_however_long_the_sub_step(
    kind, name, sizes, lead, speed, integrator, h, x64
):
    damping = {"d": 0.01} if kind is JointElasticity else {}
    twin, key = mass_with(integrator, dt=h, mass=0.5).extend(kind(**damping)), f"{kind.name}.rail"
    memory = {key: {"lead": jnp.array(lead), "speed": jnp.array(speed)}}

    @jax.jit
    @jax.vmap
    def simulate(size):
        params = twin.params | {f"{key}.{name}": size}
        start = twin.infer(jnp.array([0.0, 1.0]), params)._replace(memory=memory)
        return rollout(twin, params, start, jnp.zeros((200, 1))).states

    states = simulate(jnp.array(sizes))

    lead, speed = lead_of(states, key)
    load, motor = states.v[..., 0], states.v[..., 0] + speed
    spring = 0.5 * np.array(sizes)[:, None] * lead**2 if kind is JointElasticity else 0.0
    energy = 0.5 * 0.25 * (load**2 + motor**2) + spring
    assert np.all(np.diff(energy) <= 1e-12 * energy[:, :1])
    assert kind is Backlash or np.all(energy[:, -1] < energy[:, 0])


@every_transmission
def test_a_joint_with_a_transmission_follows_two_bodies_integrated_by_another_solver(x64, effect):
    """A pendulum under a wandering torque: its motor and its rod as bodies of their own."""
    share, inertia, step = 0.3, 1.0 / 3.0, 1e-3
    effect = type(effect)(0, motor_share=share, **effect.values)
    twin = twins.make("PendulumReal", dt=step, substeps=1).extend(effect)
    k, d, gap = (effect.values.get(name, 0.0) for name in ("k", "d", "gap"))

    def transmitted(lead, speed):
        if k:
            return k * lead + d * speed
        # Stiff teeth, so strongly damped (20 times critically) that they do not rebound.
        depth = max(abs(lead) - 0.5 * gap, 0.0)
        hard = 2e5 * depth + (4.7e3 * np.sign(lead) * speed if depth else 0.0)
        return np.sign(lead) * max(hard, 0.0)

    def two_bodies(t, x):
        rod, motor, v, w = x
        s, u = transmitted(motor - rod, w - v), 1.5 * np.sin(3.0 * t)
        load = (s + 5.0 * np.sin(rod)) / ((1 - share) * inertia)
        return [v, w, load, (u - s) / (share * inertia)]

    time, exact = step * np.arange(1501), {"rtol": 1e-9, "atol": 1e-11, "max_step": step}
    reference = solve_ivp(two_bodies, (0.0, 1.5), [2.5, 2.5, 0.0, 0.0], "LSODA", time, **exact)
    start = twin.infer(jnp.array([np.cos(2.5), np.sin(2.5), 0.0]), twin.params)
    torques = jnp.asarray(1.5 * np.sin(3.0 * (time[:-1] + 0.5 * step)))[:, None]

    q = rollout(twin, twin.params, start, torques).states.q
    rigid = rollout(twin.base, twin.base.params, start._replace(memory={}), torques).states.q

    # First order in a step of 1 ms, at speeds up to 1 rad/s.
    assert np.abs(q[:, 0] - reference.y[0]).max() < 1e-3
    assert np.abs(rigid[:, 0] - reference.y[0]).max() > 0.03


@every_transmission
def test_between_several_joints_it_acts_as_two_bodies_do(x64, effect):
    """The load's acceleration is that of the mechanism without the motor's inertia."""
    plain = twins.make("Acrobot", dt=1e-7)
    twin = plain.extend(type(effect)(1, **effect.values))
    q, v = jnp.array([0.3, -0.2]), jnp.array([0.5, 1.0])
    memory = {"lead": jnp.array(0.05), "speed": jnp.array(0.4)}
    command = jnp.array([0.7])

    key = f"{effect.name}.elbow"
    after = twin.step(State(q, v, {key: memory}), command, twin.params)

    inertia = np.array(plain.mass_matrix(q, plain.params))
    motor = 0.5 / np.linalg.inv(inertia)[1, 1]
    between = 5.0 * 0.05 + 0.1 * 0.4 if effect.name == "joint_elasticity" else 0.0
    load = inertia - motor * np.diag([0.0, 1.0])
    force = np.array([0.0, between]) - np.array(plain.bias(q, v, plain.params))
    accelerations = np.linalg.solve(load, force)
    # First order in a step of 1e-7 s.
    np.testing.assert_allclose((after.v - v) / 1e-7, accelerations, rtol=1e-5)
    relative = (0.7 - between) / motor - accelerations[1]
    assert float(after.memory[key]["speed"] - 0.4) / 1e-7 == pytest.approx(relative, rel=1e-5)


def test_the_motors_share_survives_the_spec_makes_another_program_and_leaves_both_some_inertia():
    for share in (0.0, 1.0):
        with pytest.raises(EffectError, match=f"between 0 and 1, both excluded, got {share}"):
            Backlash(motor_share=share)
    twin = twins.make("Pendulum").extend(JointElasticity(k=3.0, motor_share=0.2))

    assert twins.from_spec(twin.to_spec(), [JointElasticity]).effects[0].motor_share == 0.2
    assert twins.make("Pendulum").extend(JointElasticity(k=3.0)) != twin


def test_half_the_sub_step_quarters_the_error_of_a_damped_axis_on_a_spring(x64):
    # Damping makes what drives the motor apart change within a sub-step.
    pushes = 2.0 * np.sin(0.3 * np.arange(100))[:, None]

    def position(substeps):
        axis = twins.make("LinearAxis", dt=0.02, damping=3.0).at_interval(0.02, substeps)
        twin = axis.extend(JointElasticity(k=13.0, d=0.5))
        start = twin.infer(jnp.zeros(2), twin.params)
        return rollout(twin, twin.params, start, jnp.asarray(pushes)).states.q[:, 0]

    exact = position(256)
    coarse, fine = (np.abs(position(n) - exact).max() for n in (4, 8))

    np.testing.assert_allclose(coarse / fine, 4.0, rtol=0.1)


def test_inside_the_gap_the_motor_does_not_reach_the_load(x64):
    # A motor of 0.25 kg crosses half the gap in sqrt(2 * 0.1 * 0.25 / 0.4) = 0.354 s.
    twin = mass_with(rk4, dt=0.001, mass=0.5).extend(Backlash(gap=0.2))

    states = moved(twin, np.full(800, 0.4)).states

    time, meeting = 0.001 * np.arange(801), np.sqrt(2.0 * 0.1 * 0.25 / 0.4)
    before, later = time < meeting - 0.002, time > meeting + 0.003
    np.testing.assert_allclose(states.q[before, 0], 0.0, atol=1e-12)
    lead, speed = lead_of(states, "backlash.rail")
    np.testing.assert_allclose(lead[before], 0.5 * 0.4 / 0.25 * time[before] ** 2, atol=1e-3)
    # They meet without rebound, and go on as one body that has had the push from the beginning.
    np.testing.assert_allclose(lead[later], 0.1, rtol=1e-12)
    np.testing.assert_allclose(speed[later], 0.0, atol=1e-12)
    np.testing.assert_allclose(states.v[later, 0], 0.4 / 0.5 * time[later], rtol=1e-9)
