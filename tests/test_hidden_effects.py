"""
Something is hidden in data of MuJoCo's engine, and `diagnose` must find it, or say that nothing is.

What is hidden depends on ``SB3_HDS_SALT``: continuous integration draws a new number each time. The
generator and the judge of names are tested first: a wrong truth would make any verdict look wrong.
"""

import dataclasses
import json
import os
from collections import Counter

import hidden_cases
import hidden_effects
import hidden_scores
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pandas as pd
import pytest
import same_cause
from hidden_cases import NULLS, SHARES, believed, kind_of, nothing, sensed, spread
from hidden_scores import prepared, scores
from independent_rigs import SYSTEMS, Planted, _moment, modelled, simulate
from scipy.stats import binom

from sb3_hds import diagnose, effects

SALT = int(os.environ.get("SB3_HDS_SALT", "0"))
#: kinds of the twenty cases
KINDS = Counter({"effect": 12, "null": 2, NULLS[1]: 1, NULLS[2]: 1, "outside": 2, "pair": 1})
KINDS["still"] = 1
# Of so many runs of these tests, one may fail though every rate is what it has to be.
RUNS = 200


@pytest.fixture(params=SYSTEMS)
def somewhere(request):
    """A rig, its model and data in some state, and the twin with the same change of inertia."""
    rig, rng = SYSTEMS[request.param], np.random.default_rng(3)
    change = 0.1 * hidden_cases.base_value(request.param)
    model = modelled(rig, [], change)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = rng.uniform(-1.0, 1.0, (2, rig.dof))
    data.ctrl[:] = rig.torque
    mujoco.mj_forward(model, data)
    twin, name = believed(request.param), rig.base[0]
    return rig, model, data, twin.with_parameters(**{name: twin.values[name] + change})


def test_a_changed_inertia_and_the_planted_load_are_those_of_the_twin(somewhere):
    rig, model, data, twin = somewhere
    engine = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, engine)
    with jax.enable_x64(True):
        q, v = jnp.asarray(data.qpos), jnp.asarray(data.qvel)
        load, matrix = twin.bias(q, v, twin.params), twin.mass_matrix(q, twin.params)

    np.testing.assert_allclose(matrix, engine, rtol=1e-6)  # single-precision parameters
    for joint in range(rig.dof):
        moment = _moment(model, data, rig, joint, {})
        assert moment.load == pytest.approx(float(load[joint]), rel=1e-5, abs=1e-9)


def end_of(system, *planted):
    obs, _ = simulate(SYSTEMS[system], list(planted), n_recordings=1, n_steps=50, seed=5)
    return obs[0]


def test_a_late_sensor_keeps_its_bias_and_a_reversed_joint_turns_position_and_velocity():
    late, biased = (
        Planted("sensor_delay", 0, {"delay": 0.04}),
        Planted("sensor_bias", 0, {"bias": 0.3}),
    )
    shifted = end_of("pendulum", late)
    np.testing.assert_allclose(end_of("pendulum", biased, late)[:, 0], shifted[:, 0] + 0.3)
    np.testing.assert_allclose(shifted[2:, 0], end_of("pendulum")[:-2, 0])
    turned = end_of("furuta", Planted("reversed_joint", 1, {"flipped": 1.0}))
    np.testing.assert_allclose(turned, end_of("furuta") * [1.0, -1.0, 1.0, -1.0])


def test_dry_friction_of_the_engine_is_dry():
    # Thrown with a speed of 1 m/s on a level axis without damping, the mass stops after m v / tau.
    rig = dataclasses.replace(SYSTEMS["linear_axis"])
    model = modelled(rig, [Planted("coulomb_friction", 0, {"tau_c": 4.0})])
    model.dof_damping[:] = 0.0
    data = mujoco.MjData(model)
    data.qvel[0] = 1.0
    while data.time < 0.45:
        mujoco.mj_step(model, data)
    assert data.qvel[0] == pytest.approx(1.0 - 0.45 * 4.0 / 2.0, abs=2e-3)
    while data.time < 0.52:
        mujoco.mj_step(model, data)
    assert abs(data.qvel[0]) < 1e-3


def test_an_encoder_rounds_to_its_tick():
    true = np.linspace(-3.0, 3.0, 100_001)[:, None] * spread("pendulum")
    seen = sensed(true, "pendulum", "tick", np.random.default_rng(0))
    # Rounding is off by the tick over the square root of 12.
    error = (seen - true).std(0) / spread("pendulum")
    np.testing.assert_allclose(error, hidden_cases.NOISES["tick"], rtol=0.01)


def test_of_a_thousand_cases_each_kind_of_null_has_120():
    wanted = hidden_effects.numbers(1000, list(hidden_cases.RIGS), None)
    kinds = Counter(
        kind_of(system, n)[0]
        for system, cases in wanted.items()
        if system in SYSTEMS
        for n in cases
    )
    assert kinds == {kind: 10 * share for kind, share in SHARES.items()}
    asked = Counter(
        kind_of("pendulum", n)[0]
        for n in wanted["pendulum"]
        if kind_of("pendulum", n)[1] % hidden_cases.ASKED == 0
    )
    assert asked == {kind: -(-2 * share // hidden_cases.ASKED) for kind, share in SHARES.items()}


def test_every_effect_is_planted():
    names = {name for rig in SYSTEMS.values() for name in hidden_cases.plantable(rig)}
    assert names == {kind.name for kind in effects.ALL} | {"reversed_joint", "parameter"}


def test_every_declared_equivalence_has_a_condition():
    declared = {frozenset((kind.name, other)) for kind in effects.ALL for other in kind.equivalents}
    assert declared <= set(same_cause.CONDITIONS)


def judged(effect, named, v, *, index=0, values=(), u=1.0, system="double_pendulum"):
    """Whether names are right where one effect was planted and joints move at given velocities."""
    planted = Planted(effect, index, dict(values))
    case = dataclasses.replace(nothing(system, "1 %"), kind="effect", planted=(planted,))
    v = np.stack([v, v], 1)
    motion = np.concatenate([0.02 * np.cumsum(v, 0), v], 1)
    same = same_cause.equals(case, motion, np.full_like(v, u), named, {})
    return same_cause.right(";".join(case.truths), same, named[0])


FORTH, BACK_AND_FORTH = np.full(400, 2.0), 2.0 * np.sin(np.arange(400) / 20.0)


def test_a_name_is_right_at_its_place_only():
    assert judged("viscous_friction", ["viscous_friction.joint1"], BACK_AND_FORTH)
    assert not judged("viscous_friction", ["viscous_friction.joint2"], BACK_AND_FORTH)
    assert not judged("constant_force", ["coulomb_friction.joint2"], FORTH)


def test_equivalents_are_right_under_their_condition_only():
    for one, other in (
        ("constant_force", "coulomb_friction.joint1"),
        ("viscous_friction", "directional_viscous_friction.joint1"),
        ("dead_zone", "coulomb_friction.joint1"),
    ):
        assert judged(one, [other], FORTH), one
        assert not judged(one, [other], BACK_AND_FORTH), one
    for v_s, same in ((0.1, True), (1.0, False)):
        values = {"tau_c": 0.1, "tau_s": 0.2, "v_s": v_s}
        assert (
            judged("stribeck_friction", ["coulomb_friction.joint1"], FORTH, values=values) is same
        )


def test_two_causes_may_be_one_and_the_zero_of_the_first_angle_is_a_tilt():
    pair = ["coulomb_friction.joint1", "constant_force.joint1"]
    assert judged("directional_coulomb_friction", pair, BACK_AND_FORTH)
    assert not judged("directional_coulomb_friction", pair[:1], BACK_AND_FORTH)
    for index, same in ((0, True), (1, False), (2, False)):
        said = {"index": index, "values": {"bias": 0.1}}
        assert judged("sensor_bias", ["parameter.tilt"], BACK_AND_FORTH, **said) is same


def test_a_lag_is_a_delay_where_commands_are_slow():
    slow = np.sin(np.arange(400) / 10.0)
    for delay, same in ((0.002, True), (0.15, False)):
        named = ["motor_lag.motor1"]
        assert (
            judged("action_delay", named, FORTH, values={"delay": delay}, u=slow[:, None]) is same
        )


def row_of(case, kind, verdict="none", named="", **more):
    """A case of the table in which nothing was measured but the verdict."""
    row = {"factor": 0.0, "noise": "1 %", "disturbance": 0.0, "seconds": 1.0, "asked": False}
    row |= {"truth": "", "same": "{}", "more": "", "moved": "", "estimate": "{}"}
    row |= {"at_the_end": np.nan, "oracle": np.nan, "verdict": verdict, "named": named}
    return row | {"set": named, "system": "pendulum", "case": case, "kind": kind} | more


def score(rows, label):
    return next(s for s in scores(prepared(pd.DataFrame(rows)), "full") if s.label == label)


def test_a_name_given_to_a_null_is_an_alarm_and_a_wrong_name():
    rows = [row_of(n, "null") for n in range(39)]
    rows += [row_of(39, "null", "named", "coulomb_friction.hinge")]
    truth = "coulomb_friction.hinge"
    rows += [row_of(40, "effect", "named", truth, truth=truth)]

    alarms, right = score(rows, "false alarms: null"), score(rows, "right among named verdicts")

    assert (alarms.value, alarms.n, alarms.reached) == (1 / 40, 40, "yes")
    # Wilson's interval for 1 of 40, from its formula with z = 1.96.
    z2, p, n = 1.959964**2, 1 / 40, 40
    centre, half = (p + z2 / (2 * n)), np.sqrt(z2 * p * (1 - p) / n + (z2 / (2 * n)) ** 2)
    ends = [(centre - half) / (1 + z2 / n), (centre + half) / (1 + z2 / n)]
    assert [alarms.low, alarms.high] == pytest.approx(ends, rel=1e-5)
    assert (right.value, right.n, right.reached) == (0.5, 2, "no")
    assert score(rows, "right name: white noise up to 1 %").value == 1.0


def test_a_later_finding_may_be_the_wrong_name_and_none_is_not_what_was_expected_outside():
    truth, also = "backlash.axis", "joint_elasticity.axis"
    estimate = json.dumps({"a": (1.0, 0.8, 1.2, 1.1), "b": (2.0, 1.9, 2.1, 4.0)})
    rows = [
        row_of(0, "effect", "named", truth, truth=truth),
        row_of(1, "effect", "named", truth, truth=truth, more=also, estimate=estimate),
        row_of(2, "pair", "named", truth, truth=f"{truth};{also}", more=also),
        row_of(3, "outside", truth="hysteresis"),
        row_of(4, "outside", "unknown", truth="hysteresis"),
    ]

    assert score(rows, "right among named verdicts").value == 2 / 3
    assert score(rows, "a wrong name, all data").value == 1 / 5
    assert score(rows, "refused: outside the catalogue").value == 1.0
    assert score(rows, "called unknown: outside the catalogue").value == 0.5
    assert score(rows[1:2], "90 % intervals that cover").value == 0.5
    missed = score(rows[1:2], "error of a parameter, median").value
    assert missed == pytest.approx(0.5 * (0.1 / 1.1 + 0.5))


def test_euler_s_twin_may_be_late_or_unknown_and_rubs_nowhere():
    late, friction = "sensor_delay.cos", "coulomb_friction.hinge"
    rows = [
        row_of(0, hidden_cases.EULERS, "unknown"),
        row_of(1, hidden_cases.EULERS, "named", late),
        row_of(2, hidden_cases.EULERS, "none", moved="speed comes 2 ms late"),
        row_of(3, hidden_cases.EULERS, "none"),
        row_of(4, hidden_cases.EULERS, "named", friction),
    ]
    assert score(rows, "Euler's twin: late or unknown").value == 3 / 5
    assert score(rows, "Euler's twin: friction named").value == 1 / 5


def test_rows_are_kept_one_by_one_and_null_stays_a_word(monkeypatch, tmp_path):
    monkeypatch.setattr(hidden_effects, "RESULTS", tmp_path)
    monkeypatch.setattr(hidden_effects, "CACHE", tmp_path / "cache")
    for row in (row_of(0, "null"), row_of(1, "effect"), row_of(0, "null", "unknown")):
        hidden_effects.keep("cases", row)

    kept = hidden_effects.read("cases")

    assert [(row["case"], row["kind"], row["verdict"]) for row in kept] == [
        (1, "effect", "none"),
        (0, "null", "unknown"),
    ]


def test_a_report_writes_a_table_for_each_question(monkeypatch, tmp_path):
    monkeypatch.setattr(hidden_effects, "RESULTS", tmp_path)
    monkeypatch.setattr(hidden_effects, "CACHE", tmp_path / "cache")
    monkeypatch.setattr(hidden_scores, "RESULTS", tmp_path)
    truth = "coulomb_friction.hinge"
    effect = {"truth": truth, "factor": 2.0, "asked": True, "at_the_end": 0.8, "oracle": 0.9}
    rules = {"rule: naive BIC": "stiffness.hinge", "gain: naive BIC": 0.3}
    for row in (
        row_of(0, "null"),
        row_of(1, "effect", "named", truth, **effect, **rules),
        row_of(2, "outside", "unknown", truth="hysteresis"),
    ):
        hidden_effects.keep("hidden_effects", row)

    hidden_scores.report("hidden_effects")

    rules = pd.read_csv(tmp_path / "hidden_effects_rules.csv").set_index("rule")
    assert rules.loc["diagnose", "right"].startswith("1.00")
    assert rules.loc["naive BIC", "right"].startswith("0.00")
    assert float(rules.loc["naive BIC", "gain over the oracle's"]) == pytest.approx(
        0.3 / 0.9, abs=0.01
    )
    assert (tmp_path / "hidden_effects.png").stat().st_size > 10_000


def chances(rates):
    """How likely each number of misses is, where each case is missed at its own rate."""
    found = np.ones(1)
    for rate in rates:
        found = np.convolve(found, (1.0 - rate, rate))
    return found


def allowed(rates):
    """The most misses that one run in 200 exceeds by chance, if they come at these rates."""
    beyond = 1.0 - np.cumsum(chances(rates))
    return int(np.argmax(beyond <= 1.0 / RUNS))


def test_allowed_misses_are_exceeded_once_in_two_hundred_runs():
    for n, rate in ((4, 0.025), (12, 0.05), (20, 0.1)):
        most = allowed([rate] * n)
        assert binom.sf(most, n, rate) <= 1.0 / RUNS < binom.sf(most - 1, n, rate)
    # Two of four and one of two would both have to be named, or two and two.
    assert allowed([0.025] * 4 + [0.1] * 2) == 2


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    print(f"SB3_HDS_SALT={SALT}")
    patch = pytest.MonkeyPatch()
    patch.setattr(hidden_cases, "CACHE", tmp_path_factory.mktemp("cache"))
    rows = []
    for place, kind in enumerate(KINDS.elements()):
        system = ("pendulum", "linear_axis")[place % 2]
        case = 1_000_000 + 1000 * SALT + place
        rows.append(
            hidden_effects.run(system, case, "quick", kind=kind, noise="1 %", most=10, rules=False)
        )
    patch.undo()
    return prepared(pd.DataFrame(rows))


@pytest.mark.expensive
def test_all_the_data_say_which_of_the_confirmed_causes_it_is():
    """
    Load-dependent friction behind a coloured torque: the half that selects prefers another cause,
    and dry friction, which is simpler, is as good as that one.
    """
    case, data, _ = hidden_cases.draw("linear_axis", 26)
    found = diagnose(
        believed("linear_axis"), data, calibrate=case.nuisances, seed=26, progress=False
    )

    assert case.truths == ("load_dependent_friction.axis",)
    assert found.findings[0].effect == "load_dependent_friction", found


@pytest.mark.expensive
def test_a_twin_half_a_step_off_is_not_right_because_nothing_could_be_proposed():
    """One half of the recordings asks for a spring, the other for a delay."""
    _, data, _ = hidden_cases.draw("pendulum_v1", 4)
    found = diagnose(believed("pendulum_v1"), data, seed=4, progress=False)

    assert found.verdict == "unknown" and "sensor_delay" in found.unexplained, found


@pytest.mark.expensive
def test_a_joint_taken_the_wrong_way_round_counts_as_found_where_the_convention_is_told():
    row = hidden_effects.run("cart_pole", 8, "quick", rules=False)

    assert row["truth"] == row["named"] == "sign_flip.track"
    assert row["verdict"] == "named"


def hidden(test):
    """Twenty diagnoses take some ten minutes."""
    return pytest.mark.expensive(pytest.mark.timeout(3600)(test))


def told(rows):
    return rows[["system", "case", "kind", "truth", "factor", "verdict", "set"]].to_string()


@hidden
def test_nothing_is_named_where_nothing_was_hidden(table):
    nulls = table[table["kind"].isin(NULLS)]
    alarms = nulls[nulls["spoke"]]
    assert len(alarms) <= allowed([0.025] * len(nulls)), told(alarms)


@hidden
def test_what_the_catalogue_does_not_hold_is_not_named(table):
    nulls, outside = table[table["kind"].isin(NULLS)], table[table["kind"] == "outside"]
    names = [*nulls["spoke"], *outside["spoke"]]
    most = allowed([0.025] * len(nulls) + [0.1] * len(outside))
    assert len(outside) and sum(names) <= most, told(outside)


@hidden
def test_names_are_right(table):
    said = table[(table["kind"] == "effect") & table["spoke"]]
    wrong = said[~said["within"]]
    # The second bound is what this test has always asked for.
    assert len(wrong) <= min(allowed([0.05] * len(said)), 2), told(wrong)


@hidden
def test_what_shows_is_found(table):
    clear = table[
        (table["kind"] == "effect") & (table["factor"] >= 4.0) & (table["disturbance"] == 0.0)
    ]
    missed = clear[~clear["within"]]
    assert len(missed) <= min(allowed([0.1] * len(clear)), 1 + len(clear) // 4), told(missed)


@hidden
def test_standing_still_says_nothing(table):
    still = table[table["kind"] == "still"]
    assert len(still) and (still["verdict"] == "not_identifiable").all(), told(still)
