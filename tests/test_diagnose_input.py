"""What `diagnose` is given by mistake, or for a second time: a clear answer each."""

import jax.numpy as jnp
import numpy as np
import pytest
from measuring import measured

from sb3_hds import diagnose, effects, twins
from sb3_hds.core import (
    NO_EFFECTS,
    Channel,
    Joint,
    JointEffect,
    Parameter,
    State,
    Trajectories,
    Twin,
)
from sb3_hds.data import SamplingWarning, audit
from sb3_hds.errors import CalibrationError, EffectError
from sb3_hds.sysid.calibrate import check_fits

FRICTION = (effects.ViscousFriction, effects.CoulombFriction)


def swinging(*hidden, **parameters):
    """:return: a driven pendulum without what is hidden, and recordings of it with that"""
    pushed = twins.make("FreePendulum", driven=True, dt=0.02)
    wander = np.random.default_rng(0).standard_normal((8, 100, 1)).cumsum(1)
    commands = 0.05 * np.sin(0.7 * wander)
    system = pushed.with_parameters(**parameters) if parameters else pushed
    return pushed, measured(
        system.extend(*hidden) if hidden else system,
        n=8,
        n_steps=100,
        noise=0.005,
        commands=commands,
    )


def asked(twin, data, kinds=FRICTION):
    return diagnose(twin, data, effects=kinds, budget="quick", progress=False)


def changed(data, change):
    obs, actions = (list(leaves) for leaves in zip(*map(data.episode, range(len(data)))))  # noqa: B905
    return Trajectories.from_arrays([change(o) for o in obs], actions, dt=data.dt)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda obs: obs * [180.0 / np.pi, 1.0], "as if 'hinge_position' were in degrees"),
        (lambda obs: obs[:, ::-1], "They are swapped"),
        (lambda obs: obs + 50.0 * (np.arange(len(obs)) == 50)[:, None], "in a single sample"),
        (lambda obs: obs * [1.0, 0.0], "'hinge_velocity' stays at exactly 0"),
    ],
)
def test_columns_that_are_not_what_the_twin_takes_them_for_get_no_name(change, says):
    twin, data = swinging()

    found = asked(twin, changed(data, change))

    assert found.verdict == "not_identifiable" and not found.findings
    assert any(says in caveat for caveat in found.caveats)


def test_one_recording_of_rest_is_refused_because_nothing_moves_with_all_other_caveats(tmp_path):
    rng = np.random.default_rng(0)
    t = np.cumsum(0.02 * rng.uniform(0.7, 1.3, 200))
    rows = np.column_stack([t, 0.01 * rng.standard_normal((200, 2)), np.zeros(200)])
    np.savetxt(tmp_path / "rest.csv", rows, delimiter=",", header="t,q,v,u", comments="")
    columns = {"time": "t", "obs": ["q", "v"], "actions": ["u"], "dt": 0.02}
    with pytest.warns(SamplingWarning):
        data = Trajectories.load(tmp_path / "rest.csv", columns=columns)

    found = asked(swinging()[0], data)

    assert found.verdict == "not_identifiable"
    assert "stands still" in found.caveats[0] and "pieces of evidence" not in str(found)
    assert any("Time stamps jitter" in caveat for caveat in found.caveats[1:])


@pytest.fixture(scope="module")
def rubbing():
    return swinging(effects.CoulombFriction(0, tau_c=0.02))


def test_an_extended_twin_is_asked_again_by_one_name_for_each_cause(rubbing):
    """Effects may be named, and a single parameter to calibrate may stand alone."""
    twin, data = rubbing
    twin = twin.extend(effects.CoulombFriction(0, tau_c=0.01))
    names = ["coulomb_friction", "viscous_friction"]

    found = diagnose(twin, data, effects=names, calibrate="mass", budget="quick", progress=False)

    assert found.verdict == "named"
    [finding] = found.findings
    assert (finding.effect, finding.alternatives) == ("coulomb_friction", ())
    assert finding.parameters["tau_c"].estimate == pytest.approx(0.02, rel=0.05)
    assert found.twin.values["coulomb_friction.hinge.tau_c"] == pytest.approx(0.02, rel=0.05)


def test_less_of_what_the_twin_has_is_told_as_what_is_added_to_it():
    twin, data = swinging()

    found = asked(twin.with_parameters(damping=0.003), data)

    estimate = found.findings[0].parameters["b"]
    assert estimate.estimate == pytest.approx(-0.003, rel=0.05)
    assert estimate.added_to == pytest.approx(0.003)


class Deaf(Twin):
    """A pendulum of one's own, whose step takes effects and does nothing with them."""

    name = "Deaf"
    dt = 0.02
    joints = (Joint("hinge", "rad"),)
    actuators = ()
    channels = (Channel("angle", "rad"), Channel("rate", "rad/s"))
    parameters = {"pull": Parameter(null=9.0, scale=1.0, unit="1/s2", lower=0.0)}

    def initial(self, key, params):
        return State(jnp.ones(1), jnp.zeros(1), {})

    def infer(self, obs, params):
        return State(obs[:1], obs[1:], {})

    def observe(self, state, params):
        return jnp.concatenate([state.q, state.v])

    def step(self, state, action, params, effects=NO_EFFECTS):
        v = state.v - self.dt * params["pull"] * jnp.sin(state.q)
        return State(state.q + self.dt * v, v, state.memory)


class Mute(Deaf):
    name = "Mute"

    def step(self, state, action, params):
        return super().step(state, action, params)


def test_a_twin_that_does_not_listen_to_effects_gets_no_verdict():
    obs = [np.stack([np.sin(0.02 * np.arange(101) + i), np.cos(0.02 * np.arange(101) + i)], 1)
           for i in range(8)]  # fmt: skip
    data = Trajectories.from_arrays(obs, [np.zeros((100, 0))] * 8, dt=0.02)

    with pytest.raises(EffectError, match="A force at hinge moves nothing in Deaf"):
        asked(Deaf(), data)
    with pytest.raises(EffectError, match="Mute cannot be extended: its step takes no effects"):
        asked(Mute(), data)


class Nondescript(JointEffect):
    name = "nondescript"
    parameters = {"a": Parameter(null=0.0, scale=0.1, unit="N m", lower=0.0)}

    def torque(self, joint, memory, params):
        return -params["a"] * joint.v


@pytest.mark.parametrize(
    ("changes", "error", "says"),
    [
        ({"effects": ["rubbing"]}, EffectError, "no effect 'rubbing'"),
        ({"effects": [effects.CoulombFriction(0)]}, EffectError, "effects are classes"),
        ({"effects": None}, EffectError, "got None"),
        ({"effects": [Nondescript]}, EffectError, "lacks explanation"),
        ({"calibrate": None}, CalibrationError, "got None"),
        ({"calibrate": "weight"}, CalibrationError, "weight"),
        ({"seed": -1}, CalibrationError, "seed must be"),
        ({"twin": "FreePendulum"}, CalibrationError, "takes a twin"),
        ({"data": np.zeros(3)}, CalibrationError, "got FreePendulum and ndarray"),
    ],
)
def test_mistakes_are_named_at_the_door(rubbing, changes, error, says):
    twin, data = rubbing
    given = {"twin": twin, "data": data, "progress": False} | changes

    with pytest.raises(error, match=says):
        diagnose(given.pop("twin"), given.pop("data"), **given)


def test_a_rig_is_pushed_as_hard_as_it_was():
    rig = twins.make("CartPole", observe="qv")
    state = State(jnp.zeros(2), jnp.zeros(2), {})

    weak, strong = (rig.step(state, jnp.array([force]), rig.params).v[0] for force in (10.0, 30.0))

    assert float(strong) == pytest.approx(3.0 * float(weak), rel=0.05)


def test_a_channel_that_is_stuck_in_one_recording_is_found():
    twin, data = swinging()
    obs, actions = (list(leaves) for leaves in zip(*map(data.episode, range(len(data)))))  # noqa: B905
    obs[3] = np.stack([obs[3][:, 0], np.full(len(obs[3]), obs[3][0, 1])], 1)

    found = audit(Trajectories.from_arrays(obs, actions, dt=data.dt), channels=twin.channels)

    [stuck] = [f for f in found.findings if type(f).__name__ == "StuckChannel"]
    assert stuck.channel == "hinge_velocity" and [p.trajectory for p in stuck.places] == [3]
    assert found.usable


def test_what_is_corrected_is_said():
    twin, data = swinging()
    pairs = [data.episode(i) for i in range(len(data))]
    late = Trajectories.from_arrays(
        [np.stack([o[2:, 0], o[:-2, 1]], 1) for o, _ in pairs],
        [a[2:] for _, a in pairs],
        dt=data.dt,
    )

    said = audit(late, channels=twin.channels).corrections

    assert len(said) == 1 and "'hinge_velocity' was shifted by -40 ms" in said[0]


@pytest.mark.parametrize(
    ("factor", "says"),
    [
        (2.0, r"data\.resample\(dt=0\.01\).*--set dt:0\.02"),
        (1.2e3, r"in milliseconds: .*scale: 0\.001}"),
        (1e6, "in microseconds: .*scale: 1e"),
    ],
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


def test_a_glitch_is_cut_out_and_said_and_hides_nothing(rubbing):
    twin, data = rubbing
    obs = np.array(data.obs)
    obs[2, 40, 0] += 3.0
    glitched = Trajectories.from_arrays(list(obs), list(np.array(data.actions)), dt=data.dt)

    found = asked(twin, glitched)

    assert [finding.effect for finding in found.findings] == ["coulomb_friction"]
    assert found.findings[0].parameters["tau_c"].estimate == pytest.approx(0.02, rel=0.2)
    [said] = [caveat for caveat in found.caveats if caveat.endswith("Cut out.")]
    assert "'hinge_position' jumps" in said
