"""What `diagnose` is given by mistake, or for a second time: a clear answer each."""

import dataclasses

import numpy as np
import pytest
from cases import each
from measuring import measured

from sb3_hds import diagnose, effects, twins
from sb3_hds.core import NO_EFFECTS, JointEffect, Trajectories
from sb3_hds.data import SamplingWarning
from sb3_hds.errors import CalibrationError, EffectError
from sb3_hds.sysid.diagnosis.preparation import hash_of
from sb3_hds.sysid.measurements import check_fits

FRICTION = (effects.ViscousFriction, effects.CoulombFriction)
TWIN = twins.make("FreePendulum", driven=True, dt=0.02)


def recorded(twin):
    wander = np.random.default_rng(0).standard_normal((8, 100, 1)).cumsum(1)
    return measured(twin, n=8, n_steps=100, noise=0.005, commands=0.05 * np.sin(0.7 * wander))


def asked(twin, data, **more):
    return diagnose(twin, data, effects=FRICTION, budget="quick", progress=False, **more)


@pytest.fixture(scope="module")
def rubbing():
    return recorded(TWIN.extend(effects.CoulombFriction(0, tau_c=0.02)))


def test_angles_in_degrees_get_no_name(rubbing):
    angles = list(rubbing.obs * [180.0 / np.pi, 1.0])
    degrees = Trajectories.from_arrays(angles, list(rubbing.actions), dt=0.02)

    found = asked(TWIN, degrees)

    assert found.verdict == "not_identifiable" and not found.findings
    assert any("as if 'hinge_position' were in degrees" in caveat for caveat in found.caveats)


def test_one_recording_of_rest_is_refused_because_nothing_moves_with_all_other_caveats(tmp_path):
    rng = np.random.default_rng(0)
    t = np.cumsum(0.02 * rng.uniform(0.7, 1.3, 200))
    rows = np.column_stack([t, 0.01 * rng.standard_normal((200, 2)), np.zeros(200)])
    np.savetxt(tmp_path / "rest.csv", rows, delimiter=",", header="t,q,v,u", comments="")
    columns = {"time": "t", "obs": ["q", "v"], "actions": ["u"], "dt": 0.02}
    with pytest.warns(SamplingWarning):
        data = Trajectories.load(tmp_path / "rest.csv", columns=columns)

    found = asked(TWIN, data)

    assert found.verdict == "not_identifiable"
    assert "stands still" in found.caveats[0] and "pieces of evidence" not in str(found)
    assert any("Time stamps jitter" in caveat for caveat in found.caveats[1:])


def test_an_extended_twin_is_asked_again_by_names_and_a_glitch_is_cut_out_and_said(rubbing):
    twin = TWIN.extend(effects.CoulombFriction(0, tau_c=0.01))
    obs = np.array(rubbing.obs)
    obs[2, 40, 0] += 3.0
    glitched = Trajectories.from_arrays(list(obs), list(rubbing.actions), dt=0.02)
    names = ["CoulombFriction", "viscous_friction"]

    how = {"calibrate": "mass", "budget": "quick", "progress": False}
    found = diagnose(twin, glitched, effects=names, **how)

    [finding] = found.findings
    assert (finding.effect, finding.alternatives) == ("coulomb_friction", ())
    assert finding.parameters["tau_c"].estimate == pytest.approx(0.02, rel=0.1)
    assert found.twin.values["coulomb_friction.hinge.tau_c"] == pytest.approx(0.02, rel=0.1)
    [said] = [caveat for caveat in found.caveats if caveat.endswith("Cut out.")]
    assert "'hinge_position' jumps" in said


def test_less_of_a_property_of_the_twin_is_reported_like_an_added_effect():
    found = asked(TWIN.with_parameters(damping=0.003), recorded(TWIN))
    estimate = found.findings[0].parameters["b"]
    assert estimate.estimate == pytest.approx(-0.003, rel=0.05)
    assert estimate.added_to == pytest.approx(0.003)


class Deaf(type(TWIN)):
    """Its step takes effects and does nothing with them."""

    name = "Deaf"

    def step(self, state, action, params, effects=NO_EFFECTS):
        return super().step(state, action, params)._replace(memory=state.memory)


class Mute(Deaf):
    name = "Mute"

    def step(self, state, action, params):
        return super().step(state, action, params)


def test_a_twin_that_does_not_listen_to_effects_gets_no_verdict(rubbing):
    with pytest.raises(EffectError, match="A force at hinge moves nothing in Deaf"):
        asked(Deaf(driven=True, dt=0.02), rubbing)
    with pytest.raises(EffectError, match="Mute cannot be extended: its step takes no effects"):
        asked(Mute(driven=True, dt=0.02), rubbing)


class Nondescript(JointEffect):
    name = "nondescript"
    parameters = {}


@each(
    ({"effects": ["rubbing"]}, EffectError, "no effect 'rubbing'"),
    ({"effects": [effects.CoulombFriction(0)]}, EffectError, "effects are classes"),
    ({"effects": [Nondescript]}, EffectError, "lacks explanation"),
    ({"calibrate": None}, CalibrationError, "got None"),
    ({"calibrate": "weight"}, CalibrationError, "weight"),
    ({"budget": "huge"}, CalibrationError, "'full' or 'quick'"),
    ({"seed": -1}, CalibrationError, "seed must be"),
    ({"data": np.zeros(3)}, CalibrationError, "got FreePendulum and ndarray"),
)
def test_mistakes_are_named_at_the_door(changes, error, says, rubbing):
    given = {"data": rubbing, "progress": False} | changes
    with pytest.raises(error, match=says):
        diagnose(TWIN, **given)


@each(
    (2.0, r"data\.resample\(dt=0\.01\).*--set dt:0\.02"),
    (1.2e3, r"in milliseconds: .*scale: 0\.001}"),
    (1e6, "in microseconds: .*scale: 1e"),
)
def test_another_interval_says_how_to_change_it_and_which_unit_it_may_be_in(factor, says):
    data = Trajectories.from_arrays([np.zeros((9, 2))], [np.zeros((8, 0))], dt=0.01 * factor)
    with pytest.raises(CalibrationError, match=says):
        diagnose(twins.make("FreePendulum"), data, progress=False)


def test_an_interval_that_a_log_cannot_tell_from_the_twins_is_the_same():
    twin = twins.make("FreePendulum", dt=0.0333333)

    for dt, fits in ((1.0 / 30.0, True), (0.03335, True), (0.0334, False)):
        data = Trajectories.from_arrays([np.zeros((9, 2))], [np.zeros((8, 0))], dt=dt)
        if fits:
            check_fits(twin, data)
            assert len(Trajectories.concatenate([data, data.resample(dt * 1.0002)])) == 2
        else:
            with pytest.raises(CalibrationError, match=r"steps by 0\.0333333 s and the data are"):
                check_fits(twin, data)


def test_a_checksum_tells_recordings_apart_that_have_the_same_numbers():
    obs, actions = np.arange(24.0).reshape(2, 3, 4), np.zeros((2, 2, 1))
    same, again = (Trajectories.from_arrays(obs, actions, dt=0.1) for _ in range(2))
    others = [
        Trajectories.from_arrays(obs, actions, dt=0.2),
        Trajectories.from_arrays(obs, actions, dt=0.1, conditions=["light", "heavy"]),
        dataclasses.replace(same, origin=np.zeros(2, int)),
    ]

    assert hash_of(same) == hash_of(again)
    assert len({hash_of(data) for data in (same, *others)}) == 4


def test_a_checksum_knows_the_shape_of_what_is_all_zero():
    one, other = (
        Trajectories.from_arrays(np.zeros((2, 3, n_obs)), np.zeros((2, 2, n_act)), dt=0.1)
        for n_obs, n_act in ((3, 0), (1, 3))
    )
    assert hash_of(one) != hash_of(other)
