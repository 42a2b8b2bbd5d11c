"""
Something is hidden in data of MuJoCo's engine, and `diagnose` must find it, or say that nothing is.

What is hidden depends on ``SB3_HDS_SALT``: continuous integration draws a new number each time. The
generator and the judge of names are tested first: a wrong truth would make any verdict look wrong.
"""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import hidden_cases
import hidden_effects
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pandas as pd
import pytest
import same_cause
from cases import each
from hidden_cases import NULLS, nominal_twin, nothing
from hidden_scores import prepared, scores
from independent_rigs import SYSTEMS, Planted, _moment, modelled, simulate

from sb3_hds import effects

SALT = int(os.environ.get("SB3_HDS_SALT", "0"))
# Of so many runs of these tests, one may fail though every rate is what it has to be.
RUNS = 200


#: of the eight cases; benchmarks/hidden_effects.py runs hundreds
KINDS = Counter(effect=4, null=1, outside=1, still=1) + Counter(NULLS[1:2])


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_changed_inertia_and_the_planted_load_are_those_of_the_twin(system):
    rig, rng = SYSTEMS[system], np.random.default_rng(3)
    change = 0.1 * hidden_cases.base_value(system)
    model = modelled(rig, [], change)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = rng.uniform(-1.0, 1.0, (2, rig.dof))
    data.ctrl[:] = rig.torque
    mujoco.mj_forward(model, data)
    engine = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, engine)
    twin, name = nominal_twin(system), rig.base[0]
    twin = twin.with_parameters(**{name: twin.values[name] + change})
    with jax.enable_x64(True):
        q, v = jnp.asarray(data.qpos), jnp.asarray(data.qvel)
        load, matrix = twin.bias(q, v, twin.params), twin.mass_matrix(q, twin.params)

    np.testing.assert_allclose(matrix, engine, rtol=1e-6)  # single-precision parameters
    planted = [_moment(model, data, rig, joint, {}).load for joint in range(rig.dof)]
    np.testing.assert_allclose(planted, load, rtol=1e-5, atol=1e-9)


def end_of(system, *planted):
    obs, _ = simulate(SYSTEMS[system], list(planted), n_recordings=1, n_steps=50, seed=5)
    return obs[0]


def test_a_late_sensor_keeps_its_bias_and_a_reversed_joint_turns_position_and_velocity():
    late = Planted("sensor_delay", 0, {"delay": 0.04})
    biased = Planted("sensor_bias", 0, {"bias": 0.3})
    shifted = end_of("pendulum", late)
    np.testing.assert_allclose(end_of("pendulum", biased, late)[:, 0], shifted[:, 0] + 0.3)
    np.testing.assert_allclose(shifted[2:, 0], end_of("pendulum")[:-2, 0])
    turned = end_of("furuta", Planted("reversed_joint", 1, {"flipped": 1.0}))
    np.testing.assert_allclose(turned, end_of("furuta") * [1.0, -1.0, 1.0, -1.0])


def judged(effect, named, v, *, index=0, values=(), u=1.0, system="double_pendulum"):
    """Whether names are right where one effect was planted and joints move at given velocities."""
    planted = Planted(effect, index, dict(values))
    case = dataclasses.replace(nothing(system, "1 %"), kind="effect", planted=(planted,))
    v = np.stack([v, v], 1)
    motion = np.concatenate([0.02 * np.cumsum(v, 0), v], 1)
    same = same_cause.equals(case, motion, np.full_like(v, u), named, {})
    return same_cause.right(";".join(case.truths), same, named[0])


LAG, PAIR = ["motor_lag.motor1"], ["coulomb_friction.joint1", "constant_force.joint1"]
FALLING, SLOW = {"tau_c": 0.1, "tau_s": 0.2}, np.sin(np.arange(400) / 10.0)[:, None]
FORTH, BACK_AND_FORTH = np.full(400, 2.0), 2.0 * np.sin(np.arange(400) / 20.0)


@each(
    # At its place only.
    ("viscous_friction", ["viscous_friction.joint1"], BACK_AND_FORTH, True, {}),
    ("viscous_friction", ["viscous_friction.joint2"], BACK_AND_FORTH, False, {}),
    ("constant_force", ["coulomb_friction.joint2"], FORTH, False, {}),
    # Equivalents under their condition only.
    ("constant_force", ["coulomb_friction.joint1"], FORTH, True, {}),
    ("constant_force", ["coulomb_friction.joint1"], BACK_AND_FORTH, False, {}),
    ("dead_zone", ["coulomb_friction.joint1"], FORTH, True, {}),
    ("stribeck_friction", PAIR[:1], FORTH, True, {"values": FALLING | {"v_s": 0.1}}),
    ("stribeck_friction", PAIR[:1], FORTH, False, {"values": FALLING | {"v_s": 1.0}}),
    # Two causes may be one, and the zero of the first angle a tilt.
    ("directional_coulomb_friction", PAIR, BACK_AND_FORTH, True, {}),
    ("directional_coulomb_friction", PAIR[:1], BACK_AND_FORTH, False, {}),
    ("sensor_bias", ["parameter.tilt"], FORTH, True, {"values": {"bias": 0.1}}),
    ("sensor_bias", ["parameter.tilt"], FORTH, False, {"values": {"bias": 0.1}, "index": 1}),
    # A lag is a delay where commands are slow.
    ("action_delay", LAG, FORTH, True, {"values": {"delay": 2e-3}, "u": SLOW}),
    ("action_delay", LAG, FORTH, False, {"values": {"delay": 0.15}, "u": SLOW}),
)
def test_a_name_is_right_where_it_is_or_no_motion_can_tell(planted, named, v, right, more):
    assert judged(planted, named, v, **more) is right


def test_every_effect_is_planted_and_every_declared_equivalence_has_a_condition():
    names = {name for rig in SYSTEMS.values() for name in hidden_cases.plantable(rig)}
    assert names == {kind.name for kind in effects.ALL} | {"reversed_joint", "parameter"}
    declared = {frozenset((kind.name, other)) for kind in effects.ALL for other in kind.equivalents}
    assert declared <= set(same_cause.CONDITIONS)


def row_of(case, kind, verdict="none", named="", **more):
    """A case of the table in which nothing was measured but the verdict."""
    row = {"factor": 0.0, "noise": "1 %", "disturbance": 0.0, "seconds": 1.0, "asked": False}
    row |= {"truth": "", "same": "{}", "more": "", "moved": "", "estimate": "{}"}
    row |= {"at_the_end": np.nan, "oracle": np.nan, "verdict": verdict, "named": named}
    return row | {"set": named, "system": "pendulum", "case": case, "kind": kind} | more


def score(rows, label):
    return next(s for s in scores(prepared(pd.DataFrame(rows)), "full") if s.label == label)


def test_a_later_finding_may_be_the_wrong_name_and_none_is_not_what_was_expected_outside():
    truth, also, euler = "backlash.axis", "joint_elasticity.axis", hidden_cases.EULERS
    estimate = json.dumps({"a": (1.0, 0.8, 1.2, 1.1), "b": (2.0, 1.9, 2.1, 4.0)})
    rows = [
        row_of(0, "effect", "named", truth, truth=truth),
        row_of(1, "effect", "named", truth, truth=truth, more=also, estimate=estimate),
        row_of(2, "pair", "named", truth, truth=f"{truth};{also}", more=also),
        row_of(3, "outside", truth="hysteresis"),
        row_of(4, "outside", "unknown", truth="hysteresis"),
        # Of Euler's twin, the speed comes late.
        row_of(5, euler, "named", "sensor_delay.cos"),
        row_of(6, euler, "none", moved="speed comes 2 ms late"),
        row_of(7, euler, "none"),
        row_of(8, euler, "named", "coulomb_friction.hinge"),
        row_of(9, "null"),
        row_of(10, "null", "named", "coulomb_friction.hinge"),
    ]

    for expected, label, some in (
        (2 / 3, "right among named verdicts", rows[:5]),
        (1 / 5, "a wrong name, all data", rows[:5]),
        (1.0, "refused: outside the catalogue", rows),
        (0.5, "called unknown: outside the catalogue", rows),
        (0.5, "90 % intervals that cover the truth", rows[1:2]),
        (0.5 * (0.1 / 1.1 + 0.5), "error of a parameter, median", rows[1:2]),
        (1 / 2, "false alarms: null", rows),
        (2 / 4, "Euler's twin: delay or unknown", rows),
        (1 / 4, "Euler's twin: friction named", rows),
    ):
        assert score(some, label).value == pytest.approx(expected), label


def allowed(rates):
    """The most misses that one run in 200 exceeds by chance, if they come at these rates."""
    chances = np.ones(1)
    for rate in rates:
        chances = np.convolve(chances, (1.0 - rate, rate))
    return int(np.argmax(1.0 - np.cumsum(chances) <= 1.0 / RUNS))


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    print(f"SB3_HDS_SALT={SALT}")
    patch = pytest.MonkeyPatch()
    patch.setattr(hidden_cases, "CACHE", tmp_path_factory.mktemp("cache"))
    rows = []
    for place, kind in enumerate(KINDS.elements()):
        system = ("pendulum", "linear_axis")[place % 2]
        case = 1_000_000 + 1000 * SALT + place
        how = {"kind": kind, "noise": "1 %", "most": 10, "rules": False}
        rows.append(hidden_effects.run(system, case, "quick", **how))
    patch.undo()
    return prepared(pd.DataFrame(rows))


# Eight diagnoses take some three minutes.
def hidden(test):
    return pytest.mark.expensive(pytest.mark.timeout(3600)(test))


def told(rows):
    return rows[["system", "case", "kind", "truth", "factor", "verdict", "set"]].to_string()


@hidden
def test_nothing_is_named_for_nulls_and_for_effects_outside_the_catalogue(table):
    nulls, outside = table[table["kind"].isin(NULLS)], table[table["kind"] == "outside"]
    alarms = nulls[nulls["spoke"]]
    assert len(alarms) <= allowed([0.025] * len(nulls)), told(alarms)
    most = allowed([0.025] * len(nulls) + [0.1] * len(outside))
    assert len(outside) and len(alarms) + sum(outside["spoke"]) <= most, told(outside)


@hidden
def test_names_are_right(table):
    said = table[(table["kind"] == "effect") & table["spoke"]]
    wrong = said[~said["within"]]
    # The second bound is what this test has always asked for.
    assert len(wrong) <= min(allowed([0.05] * len(said)), 2), told(wrong)


@hidden
def test_what_shows_is_found(table):
    clear = table.query("kind == 'effect' and factor >= 4.0 and disturbance == 0.0")
    missed = clear[~clear["within"]]
    assert len(missed) <= min(allowed([0.1] * len(clear)), 1 + len(clear) // 4), told(missed)


@hidden
def test_recordings_at_standstill_are_not_identifiable(table):
    still = table[table["kind"] == "still"]
    assert len(still) and (still["verdict"] == "not_identifiable").all(), told(still)


@hidden
def test_cases_are_spread_over_a_ray_cluster(cluster, tmp_path):
    # A copy of the benchmarks has a table of its own.
    here, without = tmp_path / "benchmarks", shutil.ignore_patterns("results", ".cache")
    shutil.copytree(Path(hidden_effects.__file__).parent, here, ignore=without)
    few = ("--cases", "15", "--systems", "pendulum", "linear_axis", "--kinds", "null")
    command = (sys.executable, here / "hidden_effects.py", *few, "--budget", "quick")

    done = subprocess.run(
        (*command, "--ray", cluster.address), capture_output=True, text=True, timeout=900
    )

    assert done.returncode == 0, done.stderr[-4000:]
    rows = pd.read_csv(here / "results" / "hidden_effects_quick.csv")
    wanted = hidden_effects.numbers(15, ["pendulum", "linear_axis"], ["null"])
    assert sorted(zip(rows["system"], rows["case"], strict=True)) == sorted(
        (system, case) for system, cases in wanted.items() for case in cases
    )
    assert len(rows) == 2 and "2 cases" in done.stdout
