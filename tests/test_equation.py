"""Equation errors in weak form: sets of causes, kinematics, conventions, on small data."""

import first_users
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import servo_leg
import small_robots as robots
from measuring import measured

from sb3_hds import Trajectories, diagnose, effects, twins
from sb3_hds.core import rollout
from sb3_hds.sysid.checks.conventions import other_convention
from sb3_hds.sysid.checks.timing import match_logged_integrator
from sb3_hds.sysid.diagnosis.preparation import prepare
from sb3_hds.sysid.equation import members
from sb3_hds.sysid.equation.assembly import assemble
from sb3_hds.sysid.equation.effect_columns import impulse_weights
from sb3_hds.sysid.equation.screening import screen
from sb3_hds.sysid.equation.terms import effective_inertia, terms
from sb3_hds.sysid.equation.weak_form import weak_rows
from sb3_hds.sysid.estimation.hypotheses import Hypotheses
from sb3_hds.sysid.measurements import white_noise
from sb3_hds.sysid.motion.joints import differences, kinematics
from sb3_hds.sysid.motion.motion import smoothed_motion
from sb3_hds.sysid.motion.smoothing import smooth
from sb3_hds.sysid.progress import Bar


def proposed(twin, data, calibrate=()):
    """Sizes of the causes that are proposed, by key and short name."""
    twin, data, _ = match_logged_integrator(twin, data)
    found = screen(twin, smoothed_motion(twin, data), effects.ALL, calibrate)
    return {m.key: m.sizes for m in found.members}


def rubbing_axis(
    length=1.0,
    time=1.0,
    force=1.0,
    cut=None,
    noise=1.0,
    pull=lambda q, v: -3.0 * v,
    dry=1.5,
    every=100,
):
    """
    A mass of 2 kg with dry and viscous friction (or another force), stepped finely; in other units
    of length, time and force, or with recordings cut at another place.
    """
    rng, fine, n = np.random.default_rng(1), 1e-4, 60_000
    obs, actions = [], []
    for _ in range(4):
        frequencies, phases = rng.uniform(0.3, 1.0, 3), rng.uniform(0.0, 6.0, 3)
        t = fine * every * np.arange(n // every)
        u = 6.0 * np.sin(2.0 * np.pi * frequencies * t[:, None] + phases).sum(1)
        q, v, rows = 0.0, 0.0, []
        for k in range(n):
            if k % every == 0:
                rows.append((q, v))
            push = u[k // every] + pull(q, v)
            slide = v + fine * push / 2.0
            v = np.sign(slide) * max(abs(slide) - fine * dry / 2.0, 0.0)
            q += fine * v
        errors = noise * rng.standard_normal((n // every + 1, 2)) * [1e-4, 2e-3]
        rows = np.array([*rows, (q, v)]) + errors
        obs.append(rows * [length, length / time])
        actions.append(force * u[:, None])
    if cut:
        obs = [piece for o in obs for piece in (o[: cut + 1], o[cut:])]
        actions = [piece for a in actions for piece in (a[:cut], a[cut:])]
    dt = fine * every * time
    twin = twins.make("LinearAxis", mass=2.0 * force * time**2 / length, dt=dt)
    return twin, Trajectories.from_arrays(obs, actions, dt=dt)


@pytest.fixture(scope="module")
def as_it_is():
    return proposed(*rubbing_axis())


def test_viscous_and_dry_friction_are_proposed_together(as_it_is):
    assert as_it_is == {
        "viscous_friction.axis": {"b": pytest.approx(3.0, rel=0.02)},
        "coulomb_friction.axis": {"tau_c": pytest.approx(1.5, rel=0.02)},
    }


@pytest.mark.parametrize(
    "units", [{"length": 1e3}, {"time": 1e-3}, {"time": 1e3}, {"force": 1e-3}, {"cut": 250}]
)
def test_the_same_data_in_other_units_give_the_same_causes(as_it_is, units):
    found = proposed(*rubbing_axis(**units))
    length, time, force = (units.get(name, 1.0) for name in ("length", "time", "force"))

    assert found.keys() == as_it_is.keys()
    per_speed = force * time / length
    assert found["viscous_friction.axis"]["b"] == pytest.approx(3.0 * per_speed, rel=0.03)
    assert found["coulomb_friction.axis"]["tau_c"] == pytest.approx(1.5 * force, rel=0.03)


def screened(**changes):
    twin, data = rubbing_axis(**changes)
    return screen(twin, smoothed_motion(twin, data), effects.ALL, ())


def test_friction_against_velocity_is_what_rubs_with_other_causes_taken_off():
    """Viscous 3 N s/m and dry 1.5 N, beside an offset of 2 N, in which no friction is."""
    twin, data = rubbing_axis(pull=lambda q, v: 2.0 - 3.0 * v)
    found = screen(twin, smoothed_motion(twin, data), effects.ALL, ())
    (curve,) = found.friction_curves([m.key for m in found.members])

    assert curve.joint == 0 and np.all(np.diff(curve.velocity) > 0.0)
    moving = np.abs(curve.velocity) > 0.1
    true = 3.0 * curve.velocity + 1.5 * np.sign(curve.velocity)
    np.testing.assert_allclose(curve.found[moving], true[moving], atol=0.1)
    # Each dot is a mean over fifty intervals, uncertain by the noise of the velocities.
    misses = (curve.measured - true)[moving]
    assert abs(misses.mean()) < 0.05 and misses.std() < 0.3
    assert found.friction_curves(["constant_force.axis"]) == ()


def test_bumps_are_wide_where_velocities_are_noisy_and_narrow_where_something_else_is_left():
    def narrowed(unknown, noise):
        pull = lambda q, v: -3.0 * v + unknown * np.sin(6.0 * q)  # noqa: E731
        twin, data = rubbing_axis(noise=noise, pull=pull)
        known = Hypotheses.about(twin, (effects.ViscousFriction, effects.CoulombFriction), ())
        rows = weak_rows(assemble(known, smoothed_motion(twin, data)), 0)
        return rows.narrowed

    assert narrowed(unknown=0.0, noise=1.0) == 1.0
    assert narrowed(unknown=2.0, noise=0.01) > 7.0


def test_a_spring_that_rests_far_from_where_the_axis_moves_is_an_offset():
    found = screened(pull=lambda q, v: -3.0 * v - 0.2 * (q - 10.0))

    assert "constant_force.axis" in {m.key for m in found.members}
    assert "stiffness.axis" not in {m.key for m in found.members}


def test_friction_that_grows_ever_slower_is_concave_and_does_not_fall_to_nothing():
    found = screened(pull=lambda q, v: -4.0 * np.sign(v) * np.sqrt(abs(v)))

    assert "concave_friction.axis" in {m.key for m in found.members}
    assert "stribeck_friction.axis" not in {m.key for m in found.members}


def test_intervals_allow_for_a_cause_that_may_be_there_too():
    """Dry friction of 1.5 N alone is estimated wrong, and its interval says that it may be."""
    found = screened()
    (alone,) = found.among(["coulomb_friction.axis"]).members
    both = {m.key: m for m in found.members}["coulomb_friction.axis"]

    assert both.doubt["tau_c"] < 0.05 and both.low["tau_c"] < 1.5 < both.high["tau_c"]
    assert abs(alone.sizes["tau_c"] - 1.5) > 0.5 and alone.low["tau_c"] < 1.5 < alone.high["tau_c"]
    assert found.doubts_of(alone) == {"coulomb_friction.axis.tau_c": alone.doubt["tau_c"]}


def test_causes_that_are_too_small_to_be_named_make_intervals_wider(monkeypatch):
    """Akaike's criterion gives them more weight than Schwarz's, by which the set is chosen."""
    found = screened(pull=lambda q, v: -3.0 * v - 0.15 * v * abs(v))
    keys = [m.key for m in found.members]
    monkeypatch.setattr(members, "_AKAIKE", found.problem.cost)

    [wide], [narrow] = (
        [m.doubt["b"] for m in each.members if m.key == "viscous_friction.axis"]
        for each in (found, found.among(keys))
    )
    assert wide > 1.5 * narrow


def test_members_of_a_set_have_other_sizes_where_one_of_them_is_left_out():
    both = screened()
    [alone] = both.among({"viscous_friction.axis"}).members

    assert {m.key for m in both.members} == {"viscous_friction.axis", "coulomb_friction.axis"}
    assert alone.sizes["b"] > 3.5
    name = "viscous_friction.axis.b"
    assert both.sizes_of({alone.key}) == {name: pytest.approx(alone.sizes["b"])}
    viscous = next(m for m in both.members if m.key == alone.key)
    value, low, high = both.intervals_of(viscous)[name]
    assert low < value == viscous.sizes["b"] < high


@pytest.mark.parametrize("dry, every", [(4.0, 400), (8.0, 200), (10.0, 400), (8.0, 600)])
def test_friction_that_mostly_holds_an_axis_is_dry_and_no_dead_zone(dry, every):
    found = proposed(*rubbing_axis(dry=dry, every=every))

    assert found == {
        "viscous_friction.axis": {"b": pytest.approx(3.0, rel=0.05)},
        "coulomb_friction.axis": {"tau_c": pytest.approx(dry, rel=0.02)},
    }


@pytest.mark.parametrize("braking", [0.0, 1e-7, 0.3, 4.0])
def test_where_the_model_brakes_a_force_counts_the_more_the_later_it_acts(braking):
    met = braking / -np.expm1(-braking) if braking else 1.0
    places = np.linspace(0.0, 1.0, 2001)[None]

    found = impulse_weights(np.array([[[2.0]]]), np.array([[[2.0 * met]]]), 0, places)

    assert np.trapezoid(found, places)[0] == pytest.approx(1.0, abs=1e-5)
    assert found[0, -1] / found[0, 0] == pytest.approx(np.exp(braking), rel=1e-4)


def waves(dt, size=6.0):
    """:return: four commands of 600 steps, sums of three sines of 0.3 to 2 Hz"""
    rng, t = np.random.default_rng(0), dt * np.arange(600)
    angles = 2.0 * np.pi * rng.uniform(0.3, 2.0, (4, 1, 3)) * t[:, None]
    return size * np.sin(angles + rng.uniform(0.0, 6.0, (4, 1, 3))).sum(-1)[..., None]


@pytest.mark.parametrize("delay, named", [(2e-4, False), (1e-3, True)])
def test_commands_are_late_from_three_hundredths_of_an_interval(delay, named):
    twin = twins.make("LinearAxis", mass=2.0, damping=3.0, dt=0.01)
    real = twin.extend(effects.ActionDelay(delay=delay).at(0))
    rng, commands = np.random.default_rng(0), waves(0.01)
    with jax.enable_x64(True):
        starts = jax.vmap(lambda o: real.infer(o, real.params))(jnp.zeros((4, 2)))
        run = lambda s, a: rollout(real, real.params, s, a).obs  # noqa: E731
        moved = np.asarray(jax.vmap(run)(starts, jnp.asarray(commands)))
    obs = moved + 1e-6 * rng.standard_normal(moved.shape)

    found = proposed(twin, Trajectories.from_arrays(list(obs), list(commands), dt=0.01))

    late = {"action_delay.force": {"delay": pytest.approx(delay, rel=0.02)}}
    assert found == (late if named else {})


def test_a_lag_close_to_a_node_is_within_both_pieces_of_its_chain():
    twin = twins.make("LinearAxis", mass=2.0, damping=3.0, dt=0.01)
    real = twin.extend(effects.MotorLag(time_constant=0.0401).at(0))
    data = measured(real, n=4, noise=1e-4, commands=waves(0.01))
    p = screen(twin, smoothed_motion(twin, data), effects.ALL, ()).problem

    pieces = [i for i, item in enumerate(p.items) if item.candidate.name == "motor_lag"]
    within = [p.items[i].settings for i in pieces if not p.out_of_bounds([i])]
    assert [s["time_constant"] for two in within for s in two] == [0.025, 0.04, 0.04, 0.06]


@pytest.mark.parametrize("lag", [0.02, 0.04, 0.045])
def test_a_gain_multiplies_commands_that_are_late(lag):
    twin = twins.make("LinearAxis", mass=2.0, damping=3.0, dt=0.01)
    real = twin.extend(
        effects.TorqueGain(gain=1.5).at(0),
        effects.MotorLag(time_constant=lag).at(0),
        effects.ViscousFriction(b=4.0).at(0),
    )
    data = measured(real, n=4, noise=1e-4, commands=waves(0.01))
    found = screen(twin, smoothed_motion(twin, data), effects.ALL, ())

    sizes = found.sizes_of(["viscous_friction.axis", "torque_gain.force", "motor_lag.force"])
    assert sizes == {
        "viscous_friction.axis.b": pytest.approx(4.0, rel=0.05),
        "torque_gain.force.gain": pytest.approx(1.5, rel=0.03),
        "motor_lag.force.time_constant": pytest.approx(lag, rel=0.1),
    }


@pytest.mark.parametrize("believed, calibrate", [(5.0, []), (8.0, ["mass"])])
def test_a_joint_whose_friction_carries_the_torque(believed, calibrate):
    found = proposed(*first_users.joint_with_friction(believed), calibrate)

    assert found.keys() == {"viscous_friction.axis", "coulomb_friction.axis"}
    assert found["viscous_friction.axis"]["b"] == pytest.approx(22.0, rel=0.05)
    assert found["coulomb_friction.axis"]["tau_c"] == pytest.approx(13.0, rel=0.05)


def test_a_force_meets_what_a_servo_brakes_within_a_step():
    twin = twins.from_mujoco(servo_leg.XML, dt=servo_leg.DT)
    rng = np.random.default_rng(0)
    q, v, u = (rng.uniform(-0.5, 0.5, (4, 3)) for _ in range(3))
    found = terms(twin, twin.params, q, v, u)

    inertia = effective_inertia(twin, twin.params, q, v, u, found)

    # An implicit step takes the servo's damping at its end: h kv beside the mass matrix.
    expected = found.mass + servo_leg.DT * 1.5 * np.eye(3)
    np.testing.assert_allclose(inertia, expected, rtol=1e-6, atol=1e-9)


def test_a_late_bus_and_dry_friction_of_a_servo_driven_leg_are_found_from_positions_alone():
    found = proposed(servo_leg.leg(), servo_leg.recorded(delay=0.012, friction=0.2))

    # A tenth of the interval at which commands are held.
    assert found.pop("action_delay.all") == {"delay": pytest.approx(0.012, abs=5e-4)}
    assert found.keys() == {f"coulomb_friction.{name}" for name in ("hip", "thigh", "calf")}
    for sizes in found.values():
        assert sizes["tau_c"] == pytest.approx(0.2, rel=0.1)


def test_an_encoder_that_counts_too_much_scales_position_and_velocity():
    found = proposed(*first_users.scaled_angle(), ["inertia", "damping"])

    assert found == {"sensor_scale.hinge": {"scale": pytest.approx(1.04, abs=0.005)}}


@pytest.mark.parametrize("slower", [1.0, 50.0])
def test_a_spring_that_hardens_is_one_whatever_the_clock(slower):
    given = first_users.fast_oscillator(slower)
    found = proposed(*given, ["stiffness", "damping"])

    assert found.keys() == {"cubic_stiffness.mass"}
    assert found["cubic_stiffness.mass"]["k3"] == pytest.approx(6e5 / slower**2, rel=0.05)


@pytest.mark.parametrize(
    "given, name",
    [
        (first_users.free_pendulum, None),
        (lambda: first_users.free_pendulum(zero="up"), "zero"),
        (lambda: first_users.free_pendulum(factor=180.0 / np.pi), "degrees"),
        (first_users.flipped_command, "direction"),
    ],
)
def test_other_conventions_of_a_log_are_reported_before_any_cause(given, name):
    twin, data = given()
    found = other_convention(twin, smoothed_motion(twin, data), ())

    assert (found and found.key.partition(".")[0]) == name


def shaken_axis(late):
    """Two recordings of a mass of 2 kg, shaken at about 1 Hz by commands that are late [s]."""
    obs, actions, fine = [], [], 1e-3
    for phase in (0.0, 2.0):

        def pull(t, phase=phase):
            return sum(
                6.0 * np.sin(2.0 * np.pi * f * t + k * phase)
                for k, f in ((1, 0.9), (2, 1.0), (3, 1.1))
            )

        t = fine * np.arange(12_001)
        v = np.cumsum(pull(t - late)) * fine / 2.0
        q = np.cumsum(v) * fine
        obs.append(np.stack([q, v], 1)[::10])
        actions.append(pull(t[:-1:10])[:, None])
    return twins.make("LinearAxis", mass=2.0, dt=0.01), Trajectories.from_arrays(
        obs, actions, dt=0.01
    )


def test_commands_that_are_late_by_half_a_period_have_no_wrong_sign():
    twin, data = shaken_axis(late=0.0)
    turned = Trajectories.from_arrays(data.obs, -data.actions, dt=data.dt)
    found = other_convention(twin, smoothed_motion(twin, turned), ())
    assert found.key == "direction.axis" and "As well possible: The command" in found.words

    twin, data = shaken_axis(late=0.5)
    assert other_convention(twin, smoothed_motion(twin, data), ()) is None


@pytest.fixture(scope="module")
def swinging_arm():
    """An arm of three joints with more friction than its model, and a log of it."""
    limits = {"range": "-6 6", "damping": "0.6", "frictionloss": "0"}
    model = robots.chain(3, actuator="none", **limits)
    options = {"actuators": {"kind": "torque", "limit": {"j0": 3.0, "j1": 6.0, "j2": 2.0}}}
    nominal = twins.from_mujoco(model, dt=0.01, ignore="limits", **options)
    rubbing = [effects.CoulombFriction(f"j{i}", tau_c=tau) for i, tau in enumerate((0.2, 0.3, 0.1))]
    real = nominal.at_interval(0.01, 10).extend(*rubbing)
    return nominal, measured(real, n=4, n_steps=400, noise=1e-4)


def rewritten(data, obs=1.0, actions=1.0, order=(0, 1, 2)):
    columns = [*order, *(3 + i for i in order)]
    return Trajectories.from_arrays(
        (data.obs * np.asarray(obs))[:, :, columns], data.actions * np.asarray(actions), dt=data.dt
    )


@pytest.mark.parametrize(
    ("written", "believed", "keys", "words"),
    [
        ({}, {}, None, ""),
        ({"obs": [1, -1, -1, 1, -1, -1]}, {}, {"direction.j1.j2"}, "scale: -1"),
        ({"order": (0, 2, 1), "actions": [1, 1, -1]}, {}, {"order.j1.j2", "command.j2"}, "in the"),
        ({}, {"tilt_x": np.pi / 2}, {"mounting"}, "--set tilt_x:0.0000 tilt_y:0.0000"),
        ({"actions": 1 / 8.0}, {}, {"torque.j0.j1.j2"}, "7.43, 7.64, 7.32"),
        ({"obs": [1, 60, 1, 1, 60, 1]}, {}, {"gear.j1"}, "about 60"),
        ({"obs": [1, 60, 40, 1, 60, 40]}, {}, {"gear.j1.j2"}, "the motor"),
    ],
)
def test_what_else_an_arm_may_be_counted_in(swinging_arm, written, believed, keys, words):
    nominal, data = swinging_arm
    twin, log = nominal.with_parameters(**believed), rewritten(data, **written)

    found = other_convention(twin, smoothed_motion(twin, log), ())

    assert (found and {*found.key.split("+")}) == keys
    assert found is None or words in found.words


def test_velocities_are_compared_with_differences_of_positions():
    rng, dt = np.random.default_rng(0), 0.01
    recordings = []
    for phase in range(4):
        t = dt * np.arange(1001)
        q, late = np.sin(2.0 * t + phase), t - 0.5 * dt
        v = 1.03 * 2.0 * np.cos(2.0 * late + phase) + 0.02
        noise = rng.standard_normal((2, 1001, 1)) * [[[1e-5]], [[1e-3]]]
        recordings.append((q[:, None] + noise[0], v[:, None] + noise[1]))
    found = kinematics(recordings, dt, np.array([np.pi]))

    assert found.scale == pytest.approx([1.03], rel=1e-3)
    assert found.zero == pytest.approx([0.02], rel=0.05)
    assert found.velocity_time == pytest.approx([-0.5], abs=0.05)
    assert not found.agrees[0]


@pytest.mark.parametrize(("scale", "agree"), [(1.0, 20), (1.2, 0)])
def test_a_single_recording_agrees_with_differences_to_within_its_noise(scale, agree):
    dt, found = 0.01, []
    t = dt * np.arange(1001)
    for seed in range(20):
        noise = np.random.default_rng(seed).standard_normal((2, 1001, 1)) * [[[0.05]], [[1e-3]]]
        q, v = (
            np.sin(2.0 * t)[:, None] + noise[0],
            scale * 2.0 * np.cos(2.0 * t)[:, None] + noise[1],
        )
        found.append(bool(kinematics([(q, v)], dt, np.array([np.pi])).agrees[0]))

    assert sum(found) == pytest.approx(agree, abs=1)


@pytest.mark.parametrize("velocity_time", [-0.5, 0.0, 0.2, 0.5])
def test_differences_of_a_parabola_are_its_slope_when_the_velocity_is_true(velocity_time):
    t = 0.1 * np.arange(6.0)
    found = differences(np.stack([3.0 * t**2, t], 1), 0.1, velocity_time)

    # At both ends there is one difference only.
    np.testing.assert_allclose(found[1:-1, 0], 6.0 * (t + 0.1 * velocity_time)[1:-1], atol=1e-12)
    np.testing.assert_allclose(found[:, 1], 1.0)


def test_smoothing_removes_noise_and_no_motion():
    rng, dt = np.random.default_rng(0), 0.01
    t = dt * np.arange(1001)
    q, v = np.sin(2.0 * t), 2.0 * np.cos(2.0 * t)
    noisy_q, noisy_v = (x + s * rng.standard_normal(1001) for x, s in ((q, 1e-3), (v, 0.05)))
    found = smooth(noisy_q, noisy_v, dt)

    assert white_noise([noisy_v]) == pytest.approx(0.05, rel=0.1)
    assert found.noise_v == pytest.approx(0.05, rel=0.1)
    assert np.std(found.v - v) < 2.0 * found.error_v < 0.02
    assert np.std(found.a + 4.0 * q) < 0.2


def test_dry_friction_that_carries_the_torque_is_not_smoothed_by_sub_steps():
    """A mass of 2 kg against 9 N of dry and 4 N s/m of viscous friction, logged at 50 Hz."""
    twin, data = rubbing_axis(pull=lambda q, v: -4.0 * v, dry=9.0, every=200)
    found = diagnose(twin, data, budget="quick", progress=False)

    sizes = {f.key: f.parameters for f in found.findings}
    assert sizes["coulomb_friction.axis"]["tau_c"].estimate == pytest.approx(9.0, rel=0.02)
    assert sizes["viscous_friction.axis"]["b"].estimate == pytest.approx(4.0, rel=0.1)
    assert found.twin.substeps > twin.substeps
    assert any("sub-steps" in caveat for caveat in found.caveats)


def test_a_link_that_is_lighter_than_in_the_file_is_named_and_no_gain_of_its_motors():
    """An arm of three joints that follows set points, in MuJoCo's engine at 1 ms."""
    arm = robots.chain(3)
    model = mujoco.MjModel.from_xml_string(arm)
    model.opt.timestep = 1e-3
    link = model.body("link2").id
    model.body_mass[link] *= 0.6
    model.body_inertia[link] *= 0.6
    model.dof_frictionloss[:] = [0.4, 0.4, 0.2]
    data, rng, gear = mujoco.MjData(model), np.random.default_rng(0), np.array([10.0, 9.0, 8.0])
    frequencies, phases = rng.uniform(0.15, 0.8, (3, 3)), rng.uniform(0.0, 6.0, (3, 3))
    obs, actions = [], []
    for k in range(2000):
        target = 0.35 * np.sin(2.0 * np.pi * frequencies * 0.01 * k + phases).sum(0)
        push = 30.0 * (target - data.qpos) - 2.0 * data.qvel + data.qfrc_bias
        data.ctrl[:] = np.clip(push / gear, -1.0, 1.0)
        obs.append([*data.qpos, *data.qvel])
        actions.append(data.ctrl.copy())
        mujoco.mj_step(model, data, 10)
    obs.append([*data.qpos, *data.qvel])
    twin = twins.from_mujoco(arm, dt=0.01)
    data = Trajectories.from_arrays([np.array(obs)], [np.array(actions)], dt=0.01)

    given = prepare(twin, data, effects.ALL, (), 0, Bar(False))

    sizes = {m.key: m.sizes for m in given.screened.members}
    assert {*sizes} == {f"coulomb_friction.j{i}" for i in range(3)} | {"parameter.link2_mass"}
    assert sizes["parameter.link2_mass"]["link2_mass"] == pytest.approx(
        -0.4 * twin.freed().values["link2_mass"], rel=0.1
    )
    assert given.nominal.masses == given.hypotheses.nominal.masses == ("link2",)
