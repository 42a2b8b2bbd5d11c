"""What friction, springs and constant forces do, by the formulas of mechanics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from free_mass import Mass, mass_with, moved
from scipy.special import ellipk

from sb3_hds import twins
from sb3_hds.core import JointMoment, State, explicit_euler, rk4, rollout, semi_implicit_euler
from sb3_hds.effects import (
    Cogging,
    ConcaveFriction,
    ConstantForce,
    CoulombFriction,
    CubicStiffness,
    DirectionalCoulombFriction,
    DirectionalViscousFriction,
    LoadDependentFriction,
    QuadraticDrag,
    Stiffness,
    StribeckFriction,
    ViscousFriction,
)


def torque_of(effect, v=0.0, q=0.0, actuator=0.0, load=0.0, inertia=1.0, h=1e-3):
    joint = JointMoment(*map(jnp.asarray, (q, v, actuator, load, inertia)), h)
    return float(effect.torque(joint, (), effect.values))


FRICTION = (
    *(ViscousFriction, DirectionalViscousFriction, CoulombFriction, DirectionalCoulombFriction),
    *(StribeckFriction, LoadDependentFriction, QuadraticDrag),
)


@pytest.mark.parametrize("effect", FRICTION)
def test_friction_never_adds_energy(x64, effect):
    rng = np.random.default_rng(0)
    v = jnp.asarray(rng.choice([-1.0, 0.0, 1.0], 1000) * np.exp(rng.uniform(-6, 6, 1000)))
    inertia, h = jnp.asarray(np.exp(rng.uniform(-6, 6, (2, 1000))))
    actuator, load = jnp.asarray(rng.normal(size=(2, 1000)))
    sizes = jnp.asarray(np.exp(rng.uniform(-6, 6, (1000, len(effect.parameters)))))

    def power(v, inertia, h, actuator, load, own):
        joint = JointMoment(jnp.zeros(()), v, actuator, load, inertia, h)
        return effect(0).torque(joint, (), dict(zip(effect.parameters, own, strict=True))) * v

    powers = jax.vmap(power)(v, inertia, h, actuator, load, sizes)

    assert powers.max() <= 0.0 and powers.min() < 0.0


def coast(effect, integrator, h, v, steps=1, mass=0.5, values=None):
    """Speeds of free masses under friction alone, for each of them; so may values differ."""
    twin = mass_with(integrator, dt=h, mass=mass).extend(effect)

    def speeds(v, own):
        params = twin.params | {f"{effect.name}.rail.{name}": x for name, x in own.items()}
        start = twin.infer(jnp.stack([jnp.zeros(()), v]), params)
        return rollout(twin, params, start, jnp.zeros((steps, 1))).states.v[:, 0]

    own = effect.values | (values or {})
    own = {name: jnp.broadcast_to(value, np.shape(v)) for name, value in own.items()}
    return np.asarray(jax.jit(jax.vmap(speeds))(jnp.asarray(v), own))


@each(
    (ViscousFriction, semi_implicit_euler, 10.0),
    (QuadraticDrag, semi_implicit_euler, 10.0),
    (CoulombFriction, explicit_euler, 10.0),
    (StribeckFriction, rk4, 1e-3),
)
def test_friction_alone_brings_to_rest_without_overshoot_at_any_step(effect, integrator, h, x64):
    v, sizes = np.repeat([-3.0, 0.02, 1e-3], 3), np.tile([0.01, 1.0, 100.0], 3)
    values = {name: sizes for name in effect.parameters if name not in ("v_s", "mu")}

    speeds = coast(effect(0), integrator, h, v, steps=30, values=values)

    # Rounding may leave 1e-16 of the other sign where a sub-step stops exactly.
    assert np.all(speeds * np.sign(v)[:, None] >= -1e-14)
    assert np.all(np.diff(np.abs(speeds), axis=1) <= 1e-14)


def test_viscous_friction_decays_exponentially(x64):
    v, b = np.array([[2.0], [-2.0]]), np.array([[0.4], [0.9]])
    exact = v * np.exp(-b * 0.01 * np.arange(101) / 0.5)

    both = DirectionalViscousFriction(b_pos=0.4, b_neg=0.9)
    for effect, values in ((ViscousFriction(), {"b": b[:, 0]}), (both, {})):
        speeds = coast(effect, rk4, 0.01, v[:, 0], steps=100, values=values)
        np.testing.assert_allclose(speeds, exact, rtol=2e-9)  # RK4: (b h / m)^5 / 120 per step


def test_dry_friction_decelerates_evenly_and_then_stops(x64):
    # tau_c / m = 0.4 m/s2: from 2 m/s standstill after 5 s.
    speeds = coast(CoulombFriction(tau_c=0.2), semi_implicit_euler, 0.01, [2.0], steps=700)[0]

    time = 0.01 * np.arange(701)
    sliding = 2.0 - 0.4 * time > 0.1  # ten times the width over which the sign is smoothed
    np.testing.assert_allclose(speeds[sliding], (2.0 - 0.4 * time)[sliding], rtol=1e-6)
    # At standstill the smoothed law leaves exp(-0.4 / 0.01 * t): nothing after two more seconds.
    assert abs(speeds[-1]) < 1e-9


def test_stribeck_friction_falls_from_static_to_sliding_and_without_a_rise_is_coulombs(x64):
    # 0.04 rad/s is four times the width of smoothing: what that takes off is below 1e-3.
    for v in (0.04, -0.1, 0.25, 1.0):
        law = -np.sign(v) * (0.3 + 0.5 * np.exp(-((v / 0.1) ** 2)))
        falling = torque_of(StribeckFriction(tau_c=0.3, tau_s=0.8, v_s=0.1), v)
        assert falling == pytest.approx(law, rel=1e-3)
    for v in (-1.0, -0.003, 0.0, 0.02):
        both = (StribeckFriction(tau_c=0.3, tau_s=0.3), CoulombFriction(tau_c=0.3))
        assert torque_of(both[0], v) == pytest.approx(torque_of(both[1], v), rel=1e-14)


def test_concave_friction_is_viscous_at_low_speed_halved_at_its_own_and_dry_far_above(x64):
    torque = lambda v, v_s=2.0: torque_of(ConcaveFriction(b=0.3, v_s=v_s), v)  # noqa: E731

    assert torque(-2.0) == pytest.approx(0.5 * 0.3 * 2.0, rel=1e-6)
    assert torque(0.1) == pytest.approx(-0.03 / 1.05, rel=1e-6)
    assert torque(1.0, v_s=0.05) == pytest.approx(torque(3.0, v_s=0.05), rel=0.05)
    assert torque(0.0) == 0.0


def test_load_dependent_friction_counts_both_sides_of_the_gear(x64):
    effect = LoadDependentFriction(tau_c=0.1, mu=0.2)

    for actuator, load, transmitted in (
        (0.0, -1.5, 1.5),  # the load turns a motor that is off
        (2.0, 0.0, 2.0),  # the motor accelerates an inertia
        (1.5, 1.5, 3.0),  # the motor holds the load: the teeth are pressed from both sides
        (1.5, -1.5, 0.0),  # motor and weight push the same way
    ):
        found = torque_of(effect, v=-1.0, actuator=actuator, load=load)
        assert found == pytest.approx(0.1 + 0.2 * transmitted, rel=1e-9)
    # Horizontal: weight m g l / 2 = 4.9 N m helps to fall, a torque of 1 N m against it does not.
    plain = twins.make("PendulumReal", gravity=9.8, dt=1e-6, substeps=1)
    speeds = [
        twin.step(State(jnp.array([jnp.pi / 2]), jnp.ones(1), memory), -jnp.ones(1), twin.params).v
        for twin, memory in (
            (plain, {}),
            (plain.extend(LoadDependentFriction(mu=0.1)), {"load_dependent_friction.hinge": ()}),
        )
    ]
    # The bias is -4.9: actuator + bias = -5.9. Inertia 1/3.
    assert float(speeds[1][0] - speeds[0][0]) / 1e-6 == pytest.approx(-0.1 * 5.9 * 3.0, rel=1e-5)


def test_a_spring_makes_a_mass_oscillate_about_its_rest(x64):
    # omega = sqrt(k / m) = 2 rad/s.
    twin = mass_with(rk4, dt=0.05, mass=0.5).extend(Stiffness(k=2.0, q0=0.3))
    q = moved(twin, np.zeros(400), position=1.3).states.q[:, 0]
    # RK4: a phase error of (omega h)^5 / 120 per step, 3e-5 rad after 20 s.
    np.testing.assert_allclose(q, 0.3 + np.cos(2.0 * 0.05 * np.arange(401)), atol=1e-4)


def test_a_hardening_spring_has_the_period_of_the_cubic_oscillator(x64):
    # m q'' = -k3 q^3 from A at rest: T = 4 K(1/2) / (A sqrt(k3 / m)), K the elliptic integral.
    twin = mass_with(rk4, dt=0.01, mass=0.5).extend(CubicStiffness(k3=2.0))
    period = 4.0 * ellipk(0.5) / (1.5 * np.sqrt(2.0 / 0.5))
    n = int(np.ceil(2.0 * period / 0.01))

    q = moved(twin, np.zeros(n), position=1.5).states.q[:, 0]

    time = 0.01 * np.arange(n + 1)
    falling = np.flatnonzero((q[:-1] > 0.0) & (q[1:] <= 0.0))
    crossings = time[falling] + 0.01 * q[falling] / (q[falling] - q[falling + 1])
    # Linear between samples: h^2 / 8 times the curvature, which is zero at the crossing.
    assert crossings[1] - crossings[0] == pytest.approx(period, abs=1e-4)


def test_cogging_snaps_to_positions_at_a_distance_of_one_period(x64):
    cogging = Cogging(amplitude=0.4, period=0.5, phase=0.1)

    for rest in (0.1, -0.4):
        # A quarter of a period off, it pulls back with its amplitude.
        found = [torque_of(cogging, q=rest + off) for off in (0.0, 0.125, -0.125)]
        assert found == pytest.approx([0.0, -0.4, 0.4], abs=1e-12)


@each(
    (CubicStiffness(k3=1e6), rk4, 0.1, 100.0),
    (Cogging(amplitude=1e6, period=0.1), rk4, 10.0, 100.0),
    (Stiffness(k=1e6), explicit_euler, 0.1, 1e6),
)
def test_springs_beyond_what_a_sub_step_can_follow_stay_bounded(effect, integrator, h, most, x64):
    # The stiffest that acts is m / h^2, where omega h = 1: symplectic Euler and RK4 stay bounded;
    # explicit Euler grows by sqrt(2) per step, as it does with any spring of that frequency.
    twin = mass_with(integrator, dt=h, mass=0.5).extend(effect)
    q = moved(twin, np.zeros(30), position=1.0).states.q[:, 0]
    assert np.isfinite(q).all() and np.abs(q).max() < most


def test_direction_dependent_friction_is_friction_and_a_constant_force_while_moving(x64):
    one = Mass(dt=0.01).extend(DirectionalCoulombFriction(tau_pos=0.5, tau_neg=0.2))
    two = Mass(dt=0.01).extend(CoulombFriction(tau_c=0.35), ConstantForce(tau_0=-0.15))

    for speed in (2.0, -2.0):
        a, b = (moved(twin, np.zeros(150), speed=speed).states.v for twin in (one, two))
        assert np.abs(a).min() > 1.0  # far above the width of smoothing
        np.testing.assert_allclose(a, b, rtol=1e-12)
    # At rest the one stays, and the other creeps away.
    assert moved(one, np.zeros(50)).states.q[-1, 0] == 0.0
    assert moved(two, np.zeros(50)).states.q[-1, 0] < -1e-3
