"""Twins of model files: against MuJoCo's own steps, and in what they read, refuse and derive."""

import functools
import itertools
import json
import os
import re
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import small_robots as robots
from cases import each

from sb3_hds import Trajectories, effects, twins
from sb3_hds.core import State, rollout
from sb3_hds.data import audit
from sb3_hds.errors import ModelFileError, ParameterError
from sb3_hds.sysid.estimation.hypotheses import Hypotheses

EXPENSIVE = pytest.mark.expensive
pytestmark = pytest.mark.usefixtures("x64")


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


def shipped(name):
    folder = os.path.join(os.path.dirname(gymnasium.__file__), "envs/mujoco/assets")
    model = mujoco.MjModel.from_xml_path(os.path.join(folder, name))
    # What a twin leaves out, where it is told to.
    off = mujoco.mjtDisableBit
    model.opt.disableflags |= int(off.mjDSBL_CONTACT) | int(off.mjDSBL_LIMIT)
    return model


EULER, RK4, IMPLICIT = 0, 1, 3
LARGE = {
    "cheetah": lambda: shipped("half_cheetah.xml"),
    "reacher": lambda: shipped("reacher.xml"),
    "servos": lambda: robots.chain(6, actuator="position"),
    "motors": lambda: robots.chain(7),
    "held quadruped": robots.quadruped,
    "free quadruped": lambda: robots.quadruped(robots.FREE_BASE),
}


@each(
    pytest.param(lambda: robots.CART_POLE, RK4, id="cart-pole"),
    pytest.param(lambda: robots.GRIPPER, IMPLICIT, id="gripper"),
    pytest.param(lambda: robots.BALL, EULER, id="ball joint"),
    pytest.param(lambda: robots.chain(3, actuator="velocity"), IMPLICIT, id="speeds"),
    *(
        pytest.param(make, integrator, id=f"{name}, {integrator}", marks=EXPENSIVE)
        for (name, make), integrator in itertools.product(LARGE.items(), (EULER, RK4, IMPLICIT))
    ),
)
def test_a_twin_steps_as_mujoco_does(make, integrator):
    model = make()
    model = robots.compiled(model) if isinstance(model, str) else model
    model.opt.integrator = integrator
    twin, data, actions = twins.from_mujoco(model), start_of(model), commands_for(model, 200)

    q, v = simulated(twin, twin.params, jnp.array(data.qpos), jnp.array(data.qvel), actions)

    for k, action in enumerate(actions, 1):
        data.ctrl[:] = action
        mujoco.mj_step(model, data)
        # Rounding of 1e-16 per operation, grown along 200 steps.
        theirs, ours = np.r_[data.qpos, data.qvel], np.r_[q[k], v[k]]
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)


def one_step(twin, model, values, n=3):
    """Accelerations of the twin under these values and of the model, at a few states."""
    found = []
    for seed in range(n):
        data = start_of(model, seed)
        q, v, action = data.qpos.copy(), data.qvel.copy(), commands_for(model, 1, seed)
        data.ctrl[:] = action[0]
        mujoco.mj_step(model, data)
        _, ours = simulated(twin, values, jnp.array(q), jnp.array(v), action)
        found.append((np.asarray(ours[1]) - v, data.qvel - v))
    return np.stack(found, 1) / model.opt.timestep


@functools.cache
def servo_arm():
    xml = robots.chain(3, actuator="position", stiffness=4.0, springref=0.3)
    xml = re.sub(r'forcerange="[^"]*"', "", xml)
    model = robots.compiled(xml, integrator=3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return xml, twins.from_mujoco(model, payload="tip", masses=True)


# In an arm of 3 servos: parameter, value, and the same in the model.
@each(
    ("j1_damping", 0.7, [("dof_damping", 1, 0.7)]),
    ("j2_armature", 0.2, [("dof_armature", 2, 0.2)]),
    ("j0_stiffness", 9.0, [("jnt_stiffness", 0, 9.0)]),
    ("m1_kv", 7.0, [("actuator_biasprm", (1, 2), -7.0)]),
    ("m2_kp", 80.0, [("actuator_gainprm", (2, 0), 80.0), ("actuator_biasprm", (2, 1), -80.0)]),
    ("tilt_x", 0.3, [("gravity", (1, 2), 9.81 * np.array([np.sin(0.3), -np.cos(0.3)]))]),
    ("tilt_y", -0.2, [("gravity", (0, 2), 9.81 * np.array([np.sin(0.2), -np.cos(0.2)]))]),
    ("link1_mass", 3.0, [("body_mass", 2, 3.0)]),
)
def test_a_parameter_is_the_number_of_the_model(name, value, numbers):
    xml, twin = servo_arm()
    model = robots.compiled(xml, integrator=3)
    plain, _ = one_step(twin, model, twin.params)
    for field, place, number in numbers:
        if field == "gravity":
            model.opt.gravity[list(place)] = number
        else:
            getattr(model, field)[place] = number
    if name == "link1_mass":
        model.body_inertia[2] *= 3.0 / twin.values[name]  # the shape stays

    ours, theirs = one_step(twin, model, twin.params | {name: value})

    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)  # differences over 2 ms
    assert np.abs(ours - plain).max() > 1e-3


def test_a_payload_is_a_point_mass_near_its_site():
    xml, twin = servo_arm()
    spec = mujoco.MjSpec.from_string(xml)
    spec.option.integrator = 3
    site = spec.site("tip")
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, robots.compiled(xml).site("tip").quat)
    offset = np.array([0.03, -0.02, 0.05])
    load = site.parent.add_body(pos=site.pos + rotation.reshape(3, 3) @ offset)
    load.mass, load.inertia, load.ipos, load.explicitinertial = 0.4, [1e-14] * 3, [0.0] * 3, True
    values = dict(zip("xyz", offset, strict=True))
    values = {f"tip_payload_{axis}": x for axis, x in values.items()} | {"tip_payload": 0.4}

    ours, theirs = one_step(twin, spec.compile(), twin.params | values)

    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


def test_any_values_of_a_body_make_a_possible_inertia():
    """Second moments of mass stay those of some shape: here they are computed beside the twin."""
    xml, twin = servo_arm()
    model = robots.compiled(xml, integrator=3)
    body, rng = model.body("link2").id, np.random.default_rng(3)
    stretch, shear, centre = rng.uniform(-0.8, 0.8, 3), rng.uniform(-1, 1, 3), [0.02, 0.03, 0.1]
    values = {f"link2_stretch_{axis}": x for axis, x in zip("xyz", stretch, strict=True)}
    values |= {f"link2_shear_{p}": x for p, x in zip(("xy", "xz", "yz"), shear, strict=True)}
    values |= {f"link2_com_{axis}": x for axis, x in zip("xyz", centre, strict=True)}
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[body])
    principal = turn.reshape(3, 3) @ np.diag(model.body_inertia[body]) @ turn.reshape(3, 3).T
    moments = 0.5 * np.trace(principal) * np.eye(3) - principal
    upper = np.diag(np.exp(stretch))
    upper[0, 1], upper[0, 2], upper[1, 2] = shear
    moments = upper @ moments @ upper.T
    inertia, axes = np.linalg.eigh(np.trace(moments) * np.eye(3) - moments)
    axes[:, 0] *= np.linalg.det(axes)
    model.body_inertia[body], model.body_ipos[body] = inertia, centre
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.ravel())

    ours, theirs = one_step(twin, model, twin.params | values)

    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)
    assert np.linalg.eigvalsh(moments).min() > 0.0


def test_a_dc_motor_has_its_constant_and_resistance():
    model = robots.compiled(robots.GRIPPER)
    twin = twins.from_mujoco(model)
    values = twin.params | {"spin_motorconst": 0.08, "spin_resistance": 3.0}
    model.actuator_gainprm[model.actuator("spin").id, :2] = 3.0, 0.08

    ours, theirs = one_step(twin, model, values)

    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


SLIDER = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body>
<joint name="rail" type="slide" axis="1 0 0" frictionloss="{}"/><geom size="0.1" mass="2"/></body>
</worldbody></mujoco>"""


def test_dry_friction_brings_a_slider_to_rest_as_mujocos_does():
    model = mujoco.MjModel.from_xml_string(SLIDER.format(3.0))
    twin, data = twins.from_mujoco(model), mujoco.MjData(model)
    assert twin.values["rail_frictionloss"] == 3.0
    _, v = simulated(twin, twin.params, jnp.zeros(1), jnp.ones(1), np.zeros((500, 1)))

    data.qvel[:] = 1.0
    for k in range(1, 501):
        mujoco.mj_step(model, data)
        # It stops after m v / tau_c = 2 / 3 s; MuJoCo's own is soft, too.
        assert v[k, 0] == pytest.approx(max(1.0 - 1.5 * 0.002 * k, 0.0), abs=0.02)
        assert v[k, 0] == pytest.approx(data.qvel[0], abs=0.02)
    assert abs(v[-1, 0]) < 1e-3


def test_effects_are_the_models_own_friction_and_gains_and_add_to_them():
    slider = twins.from_mujoco(mujoco.MjModel.from_xml_string(SLIDER.format(1.0)))
    motor = twins.from_mujoco(robots.compiled(robots.chain(1)))
    rubbing = effects.CoulombFriction("rail", tau_c=2.0), effects.ViscousFriction("rail", b=1.0)
    for twin, added, values in (
        (slider, rubbing, {"rail_frictionloss": 3.0, "rail_damping": 1.0}),
        (motor, (effects.TorqueGain("m0", gain=0.8),), {"m0_gain": 0.8}),
    ):
        start = State(jnp.zeros(1), jnp.ones(1), {})
        action = 0.5 * jnp.ones(len(twin.actuators))
        extended, other = twin.extend(*added), twin.with_parameters(**values)
        ours, expected = (t.step(start, action, t.params).v for t in (extended, other))
        assert ours == expected and not extended.infer(jnp.zeros(2), extended.params).memory


@each(
    (robots.BALL, {"payload": "lower", "integrator": "euler"}),
    pytest.param(robots.GRIPPER, {"payload": "pad"}, marks=EXPENSIVE),
    pytest.param(robots.chain(2), {"payload": "tip", "masses": True}, marks=EXPENSIVE),
    ids=["ball", "gripper", "masses"],
)
@pytest.mark.filterwarnings("ignore:Of .* inertial parameters")
def test_derivatives_are_those_of_finite_differences_both_ways(xml, options):
    twin, rng = twins.from_mujoco(robots.compiled(xml), **options), np.random.default_rng(0)
    n, parameters = len(twin.joints), twin.parameters.values()
    values = {
        name: np.clip(twin.values[name] + 0.3 * rng.normal() * p.scale, p.lower, p.upper)
        for name, p in twin.parameters.items()
    }
    start = twin.initial(jax.random.key(0), values)._replace(v=jnp.asarray(rng.normal(size=n)))
    action = jnp.asarray(rng.uniform(-0.5, 0.5, len(twin.actuators)))
    scales = np.array([p.scale for p in parameters])

    def after(change):
        """A step, as a function of small changes of state, action and parameters."""
        tangent, push, shift = jnp.split(change, [2 * n, 2 * n + len(action)])
        params = dict(zip(values, jnp.stack([*values.values()]) + shift * scales, strict=True))
        moved = twin.step(twin.retract(start, tangent), action + push, params)
        return twin.difference(moved, start)

    here = np.zeros(2 * n + len(action) + len(scales))
    along = jax.jit(lambda x, way: jax.jvp(after, (x,), (way,)))
    weights = rng.normal(size=2 * n)

    slopes = np.stack([along(here, way)[1] for way in np.eye(len(here))], 1)
    reverse = jax.jit(lambda w: jax.vjp(after, here)[1](w)[0])(weights)

    np.testing.assert_allclose(weights @ slopes, reverse, rtol=1e-9, atol=1e-11)
    ends = [[along(sign * way, here)[0] for way in 1e-6 * np.eye(len(here))] for sign in (1, -1)]
    differences = (np.stack(ends[0], 1) - np.stack(ends[1], 1)) / 2e-6
    # Rounding of 1e-16 over 1e-6, and curvature of dry friction.
    np.testing.assert_allclose(slopes, differences, rtol=1e-6, atol=1e-7)


def test_derivatives_are_finite_in_single_precision():
    with jax.enable_x64(False):
        twin = twins.from_mujoco(robots.compiled(robots.BALL))
        start = twin.initial(jax.random.key(0), twin.params)
        loss = lambda v: jnp.sum(twin.step(start._replace(v=v), jnp.zeros(6), twin.params).q)  # noqa: E731

        slope = jax.jit(jax.grad(loss))(start.v)

    assert slope.dtype == jnp.float32 and np.isfinite(slope).all()


def test_a_difference_of_orientations_leads_from_one_to_the_other():
    twin = twins.from_mujoco(robots.compiled(robots.quadruped(robots.FREE_BASE)))
    one, other = (twin.initial(jax.random.key(i), twin.params) for i in range(2))
    n = len(twin.joints)
    assert one.q.shape == (n + 1,) and len(twin.channels) == 2 * n + 1

    way = twin.difference(other, one)
    again = twin.retract(one, way)

    np.testing.assert_allclose(again.q, other.q, rtol=0.0, atol=1e-14)
    model, theirs = robots.compiled(robots.quadruped(robots.FREE_BASE)), np.zeros(n)
    mujoco.mj_differentiatePos(model, theirs, 1.0, np.asarray(one.q), np.asarray(other.q))
    np.testing.assert_allclose(way[:n], theirs, rtol=0.0, atol=1e-14)


def test_effects_attach_to_every_joint_actuator_and_channel():
    """Those of a joint of three degrees of freedom, too; and a spring there sees its turn."""
    twin = twins.from_mujoco(robots.compiled(robots.BALL))
    at = {"joint": twin.joints, "actuator": twin.actuators, "channel": twin.channels}
    everywhere = (effects.ViscousFriction, effects.TorqueGain, effects.SensorBias)
    wanted = [kind(i) for kind in everywhere for i in range(len(at[kind.slot]))]
    wanted += [kind(1) for kind in effects.ALL if kind not in everywhere]

    extended = twin.extend(*wanted)
    spring = twin.extend(effects.Stiffness("shoulder_ry", k=2.0))

    assert len(extended.attached) == len(wanted)
    assert extended.parameters["viscous_friction.shoulder_rx.b"].unit == "N m s/rad"
    start = extended.initial(jax.random.key(0), extended.params)
    after = jax.eval_shape(extended.step, start, jnp.zeros(6), extended.params)
    assert after.q.shape == (5,)
    q, v = jnp.array([np.cos(0.2), 0.0, np.sin(0.2), 0.0, 0.0]), jnp.zeros(4)
    action = jnp.zeros(6)
    start = State(q, v, spring.infer(jnp.r_[q, v], spring.params).memory)
    pulled = spring.step(start, action, spring.params).v
    pulled -= twin.step(State(q, v, {}), action, twin.params).v
    # Turned by 0.4 rad about y. The integrator's damping and feedback belong to the inertia.
    matrix = twin.mass_matrix(q, twin.params) + twin._coupling(start, action, twin.params)
    np.testing.assert_allclose(matrix @ pulled / twin.dt, [0.0, -2.0 * 0.4, 0.0, 0.0], atol=1e-12)


def test_a_urdf_without_its_meshes_has_motors_and_its_tool():
    mesh = '<{0}><geometry><mesh filename="package://r/a.stl"/></geometry></{0}>'
    meshes = "".join(mesh.format(kind) for kind in ("visual", "collision"))
    seen = robots.URDF.replace("</inertial></link>", f"</inertial>{meshes}</link>")

    twin = twins.from_mujoco(seen, payload="tool")

    assert twin.name == "two" and [joint.name for joint in twin.joints] == ["shoulder", "elbow"]
    assert twin.actuators[0] == ("shoulder", "N m", -10.0, 10.0)
    assert twin.actuators[1] == ("elbow", "N m", -np.inf, np.inf)
    assert (twin.values["shoulder_damping"], twin.values["shoulder_frictionloss"]) == (0.3, 0.2)
    # Along the link, whose z axis is the hinge's.
    assert twin.payload.link == 1 and np.hypot(*twin.payload.position[:2]) == pytest.approx(0.2)
    assert twin.mechanism.integrator == "implicitfast" and twin.dt == 0.002


def test_targets_of_joints_are_actions_where_a_controller_closes_the_loop():
    gains = {"kind": "position", "kp": {"shoulder": 20.0, "elbow": 8.0}, "kv": 1.5, "limit": 6.0}
    twin = twins.from_mujoco(robots.URDF, actuators=gains)
    state = State(jnp.array([0.1, -0.3]), jnp.array([0.5, 2.0]), {})

    torque = twin.actuate(state, jnp.array([0.3, 1.0]), twin.params)

    # kp (target - q) - kv v, and at most 6 N m.
    expected = [20.0 * 0.2 - 1.5 * 0.5, min(8.0 * 1.3 - 1.5 * 2.0, 6.0)]
    np.testing.assert_allclose(torque, expected, rtol=1e-12)
    assert twin.values["elbow_kp"] == 8.0 and twin.parameters["elbow_kv"].unit == "N m s/rad"


def test_the_interval_of_an_environment_is_the_twins():
    env = gymnasium.make("Reacher-v5")
    twin = twins.from_mujoco(env)
    assert (twin.dt, twin.substeps) == (0.02, 2) and twin.name == "reacher"
    assert twins.from_mujoco(env, dt=0.025).substeps == 3  # no longer than the model's 10 ms


TOUCHING = robots.quadruped().replace('="0" conaffinity="0"', '="1" conaffinity="1"')
FOLLOWING = robots.URDF.replace('friction="0"/>', 'friction="0"/><mimic joint="shoulder"/>')
BELT = '<tendon><fixed name="belt"><joint joint="j0" coef="1"/></fixed></tendon>'
FILTER = '<general name="slow" joint="j0" dyntype="filter" dynprm="0.1"/>'


# What is passed, and a part of what is said.
@each(
    (TOUCHING, {}, "Contacts can happen (trunk and FL_hip, "),
    (FOLLOWING, {}, "ignore=['equality']"),
    (robots.chain(2, more=BELT), {}, "Tendons pull (belt)"),
    (robots.chain(1, option='density="1.2"'), {}, "A medium of density 1.2"),
    (robots.chain(1, actuator="none", drives=FILTER), {}, "internal dynamics (slow)"),
    (robots.chain(1, option='integrator="implicit"'), {}, "integrator 'implicit' is"),
    (robots.chain(1), {"ignore": "wind"}, "ignore takes contacts, equality"),
    (robots.chain(1), {"engine": "engine"}, "engine must be 'smooth', 'mujoco' or 'auto'"),
    (robots.chain(1), {"actuators": "servo"}, "actuators is one of 'torque'"),
    (robots.chain(1), {"payload": "tpi"}, "no site or body 'tpi'"),
    ("arm.xml", {}, "There is no file 'arm.xml'"),
    ("<mujoco><arm/></mujoco>", {}, "MuJoCo refuses this text"),
    ids=lambda value: "" if isinstance(value, str) and "<" in value else None,
)
def test_what_a_twin_cannot_be_is_refused(source, options, message):
    with pytest.raises((ModelFileError, ParameterError), match=re.escape(message)):
        twins.from_mujoco(source, **options)


def test_what_is_ignored_is_not_there():
    windy = robots.chain(2, option='density="1.2"', range="-1.5 1.2")
    one, other = (twins.from_mujoco(windy, ignore=how) for how in (["fluid"], ["fluid", "limits"]))
    assert one == twins.from_mujoco(windy, ignore="fluid") != other
    assert one.joints[0].high == 1.2 and np.isinf(other.joints[0].high)


def test_recordings_at_a_limit_of_a_joint_are_a_caveat():
    twin = twins.from_mujoco(robots.chain(2, range="-1.5 1.2"), dt=0.01)
    time = np.linspace(0.0, 8.0, 801)
    obs = np.stack([0.5 * np.sin(time), np.minimum(1.4 * np.sin(2.0 * time), 1.2)], 1)
    obs = np.concatenate([obs, np.gradient(obs, 0.01, axis=0)], 1)
    data = Trajectories.from_arrays([obs], [np.ones((800, 2))], dt=0.01)

    found = [f for f in audit(data, twin=twin).findings if type(f).__name__ == "ReachedLimit"]

    # 1.4 sin(2 t) reaches 1.2, less 0.2 % of the range, within 0.274 s of three tops in 8 s: 20 %.
    assert [finding.channel for finding in found] == ["j1"] and not found[0].blocks
    assert "Joint 'j1' is at its limit of 1.2 rad in 20 % of the samples" in str(found[0])


def test_a_twin_survives_its_spec_without_the_file():
    twin = twins.from_mujoco(robots.compiled(robots.BALL), payload="lower", dt=0.01)
    twin = twin.with_parameters(lower_payload=0.2).extend(effects.ActionDelay("x", delay=0.03))

    back = twins.from_spec(json.loads(json.dumps(twin.to_spec())), effects.KNOWN)

    assert back == twin and hash(back) == hash(twin) and back.params == twin.params
    assert back.base.channels == twin.base.channels and back.parameters == twin.parameters
    heavier = robots.compiled(robots.BALL.replace('density="900"', 'density="901"'))
    assert twins.from_mujoco(heavier, payload="lower", dt=0.01) != twin.base


def test_a_freed_arm_is_the_same_arm_with_masses_and_centres_as_parameters():
    arm = twins.from_mujoco(robots.chain(3), dt=0.01).with_parameters(j1_damping=0.7)

    one = arm.extend(effects.ActionDelay("m0", delay=0.02)).freed(["link2_com_z", "j0_damping"])
    every = arm.freed()

    added = [name for name in one.parameters if name not in arm.parameters]
    assert {"link2_mass", "link2_com_x"} < {*added} and all("link2" in name for name in added[:-1])
    assert one.values["j1_damping"] == 0.7 and one.values["action_delay.m0.delay"] == 0.02
    assert one.known_parameters == {name for name in added if "stretch" in name or "shear" in name}
    assert every.masses == ("link0", "link1", "link2") and every.freed() is every
    q, v, a = jnp.array([0.3, -0.5, 0.8]), jnp.array([1.0, -2.0, 0.5]), jnp.array([0.2, 0.1, -0.3])
    stepped = [x.step(State(q, v, {}), a, x.params) for x in (arm, every)]
    np.testing.assert_allclose(stepped[1].v, stepped[0].v, rtol=1e-5)
    back = twins.from_spec(json.loads(json.dumps(one.to_spec())), effects.KNOWN)
    assert back == one and back.base.masses == ("link2",)
    with pytest.raises(ParameterError, match="masses names 'link9', which arm3 does not have"):
        twins.from_mujoco(robots.chain(3), masses=["link9"])


def test_a_centre_of_mass_stays_near_the_joints_of_its_link():
    arm = twins.from_mujoco(robots.chain(2)).freed()
    centre = arm.parameters["link0_com_z"]
    # The next joint is 0.35 m away.
    assert -0.1 < centre.lower < 0.0 and 0.35 < centre.upper < 0.45


def test_masses_that_no_motion_tells_are_named():
    """Of a pendulum: its inertia about the hinge and two first moments."""
    pendulum = robots.robot("pendulum", """<body><joint name="hinge" axis="0 1 0"/>
      <inertial pos="0.01 0.02 -0.3" mass="1" fullinertia="0.02 0.03 0.04 0 0 0"/>
      <body name="lid" pos="0 0 0.1"><geom size="0.01"/></body></body>""")  # fmt: skip

    with pytest.warns(UserWarning, match=r"Of 11 inertial parameters of pendulum, 3 change nothing "
                      r"\(body1_com_y, .*\), and 8 act only in 3 combinations"):  # fmt: skip
        twins.from_mujoco(pendulum, masses=True)


def test_what_is_asked_of_a_robot():
    """A delay of the whole bus once; of a servo's own damping, friction is the candidate."""
    twin = twins.from_mujoco(robots.chain(2, actuator="position"))
    kinds = (effects.ActionDelay, effects.ViscousFriction, effects.CoulombFriction)

    asked = Hypotheses.about(twin, kinds, ())

    keys = {candidate.key for candidate in asked.candidates}
    assert "action_delay.all" in keys and "parameter.m0_kp" in keys
    assert "viscous_friction.j0" in keys and "coulomb_friction.j1" in keys
    assert not keys & {"parameter.m0_kv", "parameter.j0_damping", "parameter.j1_frictionloss"}
    lower = dict(zip(asked.names, asked.lower, strict=True))
    # There may be less friction than the model has.
    assert lower["viscous_friction.j0.b"] == -twin.values["j0_damping"]
