"""Several hidden causes: how cases are drawn, driven and scored, and the answers of others."""

import dataclasses
import json

import first_users
import hidden_cases
import hidden_effects
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import several_rules
from cases import each
from hidden_cases import RIGS, kind_of, nominal_twin, nothing
from independent_rigs import EVERYWHERE, Loop, Planted, modelled
from measuring import jumping, measured
from several_cases import SEVERAL, share_of_friction, visible
from several_scores import score_case

from sb3_hds import effects
from sb3_hds.sysid.checks.timing import match_logged_integrator
from sb3_hds.sysid.comparison import several
from sb3_hds.sysid.diagnosis.pipeline import Inquiry
from sb3_hds.sysid.equation.screening import screen
from sb3_hds.sysid.equation.selection import _one_for_two
from sb3_hds.sysid.motion.motion import smoothed_motion

VISCOUS, DRY = "viscous_friction.axis", "coulomb_friction.axis"


def test_one_cause_and_several_take_turns_and_other_kinds_keep_their_numbers():
    dealt = [kind_of("pendulum", number) for number in range(200)]
    alone = [turn for kind, turn in dealt if kind == "effect"]
    several = [turn for kind, turn in dealt if kind == SEVERAL]

    assert len(alone) == len(several) == 40
    assert several == list(range(40))
    assert alone == list(range(0, 80, 2))
    assert [turn for kind, turn in dealt if kind == "null"] == list(range(24))


def test_a_rotor_of_the_engine_is_that_of_the_twin():
    rig, name = RIGS["leg"], "joint1_armature"
    model = modelled(rig, [Planted(f"parameter.{name}", 1, {name: 0.02})])
    data = mujoco.MjData(model)
    data.qpos[:] = [0.3, -0.5, 0.8]
    mujoco.mj_forward(model, data)
    engine = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, engine)
    twin = nominal_twin("leg")
    twin = twin.with_parameters(**{name: twin.values[name] + 0.02})
    with jax.enable_x64(True):
        matrix = twin.mass_matrix(jnp.asarray(data.qpos), twin.params)

    np.testing.assert_allclose(matrix, engine, rtol=1e-6)


@each(("1 %", "qv"), ("tick", "q"))
def test_a_loop_computes_what_is_logged_from_what_is_reported_and_holds_it(noise, seen):
    case = dataclasses.replace(nothing("pendulum", noise, recordings=2), n_steps=50)
    still = Loop(np.array([2.0]), np.array([0.3]), np.zeros(1))
    data, _ = hidden_cases.recorded(case, seed=4, loop=still)
    positions, _ = hidden_cases.recorded(dataclasses.replace(case, seen=seen), seed=4, loop=still)

    for recording in range(2):
        reported, commands = data.episode(recording)[:2]
        expected = -2.0 * reported[:-1, 0] - 0.3 * reported[:-1, 1]
        np.testing.assert_allclose(commands[:, 0], expected, atol=1e-5)  # float32 in the log
        # What is not recorded is reported all the same.
        np.testing.assert_array_equal(positions.episode(recording)[1], commands)
    assert positions.obs.shape[-1] == len(seen)


def test_set_points_are_positions_and_their_derivatives():
    loop = Loop(np.ones(2), np.ones(2), np.array([0.5, 1.0]))
    times = np.linspace(0.0, 4.0, 4001)
    q, v = loop.set_points(np.random.default_rng(0), times)

    np.testing.assert_allclose(np.gradient(q, times, axis=0)[1:-1], v[1:-1], atol=1e-3)
    assert (np.abs(q).max(0) <= np.sqrt(3.0) * loop.amplitude).all()


def test_a_late_bus_delays_every_motor_and_friction_has_its_share():
    late = Planted("action_delay", EVERYWHERE, {"delay": 0.02})
    case = dataclasses.replace(
        nothing("double_pendulum", "tick", recordings=1), kind=SEVERAL, planted=(late,), n_steps=20
    )
    assert case.truths == ("action_delay.all",)
    data, motion_ = hidden_cases.recorded(case, seed=1)
    rubbing = dataclasses.replace(case, planted=(Planted("viscous_friction", 0, {"b": 0.1}),))
    commands = data.episode(0)[1]

    share = share_of_friction(rubbing, data, motion_)
    expected = np.sqrt(np.mean((0.1 * motion_[:, 2]) ** 2) / np.mean(commands[:, 0] ** 2))
    assert share == pytest.approx([expected, 0.0], rel=1e-5)


@each(
    # Both are named; one of them is, and the other is as likely; one is missing, or hidden.
    (dict(sets=[[VISCOUS], [DRY]]), [True, True], [True, True], True, True),
    (dict(sets=[[VISCOUS], ["dead_zone.force", DRY]]), [True, False], [True, False], False, True),
    (dict(sets=[[VISCOUS]]), [True, False], [True], False, False),
    (dict(sets=[[VISCOUS]], visible=[True, False]), [True], [True], True, True),
    # Another name means the same here; a name too many; nothing is said.
    (dict(sets=[[VISCOUS], ["a.b"]], same={DRY: ["a.b"]}), [True, True], [True, True], True, True),
    (dict(sets=[[VISCOUS], [DRY], ["a.b"]]), [True, True], [True, True, False], False, False),
    (dict(sets=[]), [False, False], [], False, False),
)
def test_sets_are_judged_cause_by_cause_and_name_by_name(said, named, right, flawless, with_sets):
    found = score_case(
        [VISCOUS, DRY], said.get("visible", [True, True]), said.get("same", {}), said["sets"]
    )

    assert (found.named, found.right) == (named, right)
    assert (found.flawless, found.flawless_with_sets) == (flawless, with_sets)


@pytest.fixture(scope="module")
def screened():
    twin, data, _ = match_logged_integrator(*first_users.joint_with_friction())
    return screen(twin, smoothed_motion(twin, data), effects.ALL, ())


def test_the_equation_hardly_tells_a_lag_from_a_delay_nor_dry_friction_from_a_dead_zone(screened):
    p = screened.problem
    told = {item.key: p.hardly_told_from(i) for i, item in enumerate(p.items)}

    assert told["dead_zone.force"] == [DRY] and told[VISCOUS] == told[DRY] == []
    assert told["motor_lag.force"] == ["action_delay.force"]


@each(6, 1)
def test_dry_friction_is_fitted_in_the_place_of_a_dead_zone(largest, monkeypatch):
    monkeypatch.setattr(several, "_MANY", largest)
    given = first_users.joint_with_friction()
    inquiry = Inquiry(*given, effects.ALL, (), 0, "quick", False)
    proposed = inquiry.screened.with_other(DRY, "dead_zone.force")
    assert {m.key for m in proposed.members} == {VISCOUS, "dead_zone.force"}
    inquiry.split_halves()

    found = inquiry._several(proposed)

    assert {f.key for f in found.findings} == {VISCOUS, DRY}


@pytest.mark.expensive
@each(
    # One cause that a delay and a scale imitate, and two that are one of two parameters.
    ("linear_axis", 16, "joint_elasticity.axis", ""),
    ("cart_pole", 7, "coulomb_friction.track", "constant_force.track"),
)
def test_a_small_set_is_compared_with_single_causes(system, number, named, more):
    found = hidden_effects.run(system, number, "quick", rules=False)

    assert (found["named"], found["more"]) == (named, more)


def test_what_is_there_shows_and_what_is_not_does_not(screened):
    shown = visible(screened, [VISCOUS, DRY, "quadratic_drag.axis", "backlash.axis"])

    # Play has no column: no equation says whether it shows.
    assert shown == [True, True, False, True]


def test_the_regression_of_others_is_the_equation_of_motion_of_the_smoothed_data(screened):
    given = several_rules.regression_of(screened)
    own = given.columns[:, [given.keys.index(VISCOUS), given.keys.index(DRY)]]
    theta, (rss,), *_ = np.linalg.lstsq(own, given.missing, rcond=None)

    # Friction is all that the model lacks, and both oppose the motion.
    assert rss / (given.missing @ given.missing) < 0.01
    assert (theta > 0.0).all()


@pytest.mark.parametrize("rule", [several_rules.by_elimination, several_rules.by_forward_bic])
def test_rules_keep_what_is_in_the_data_and_leave_what_is_not(rule):
    rng, keys = np.random.default_rng(0), ("a", "b", "b", "c", "d")
    columns = rng.standard_normal((2000, 5))
    missing = columns @ [1.0, 0.0, 0.3, 0.0, 0.0] + 0.1 * rng.standard_normal(2000)

    assert {*rule(several_rules.Regression(missing, columns, keys))} == {"a", "b"}
    assert rule(several_rules.Regression(0.0 * missing, columns, keys)) == []


def test_one_mass_takes_the_place_of_a_moment_and_an_inertia():
    twin = nominal_twin("pendulum")
    real = twin.with_parameters(mass=0.8 * twin.values["mass"])
    data = measured(real, n=4, noise=1e-4, commands=jumping(4, n_levels=30, size=0.3))
    p = screen(twin, smoothed_motion(twin, data), effects.ALL, ()).problem
    named = {item.key: i for i, item in enumerate(p.items)}
    both = [named["parameter.com"], named["parameter.inertia"]]

    one = [named["parameter.mass"]]
    assert one in _one_for_two(p, both)
    assert p.score(one) < p.score(both) < np.inf


@pytest.mark.expensive
@pytest.mark.parametrize(
    "system, case, named",
    [
        # Commands are 40 ms late, which the equation of motion takes for a lag.
        ("pendulum", 24, {"parameter.mass", "action_delay.motor"}),
        # A gain of 0.77, which is a greater mass with greater friction, and no encoder's scale.
        ("pendulum", 58, {"quadratic_drag.hinge", "coulomb_friction.hinge", "parameter.mass"}),
        # Beside much viscous friction, dry friction lowers simulated errors by little, but surely.
        ("pendulum", 28, {"viscous_friction.hinge", "coulomb_friction.hinge", "motor_lag.motor"}),
    ],
)
def test_simulation_exchanges_wrong_causes_and_keeps_small_ones(system, case, named):
    row = hidden_effects.run(system, case, "quick", rules=False)

    assert {names[0] for names in json.loads(row["sets"])} == named
