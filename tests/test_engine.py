"""MuJoCo's engine inside compiled programs."""

import json
import os
import pickle
import signal
import subprocess
import sys
import threading

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from cases import each

from sb3_hds import HDS, Trajectories, calibrate, diagnose, planning, twins
from sb3_hds.core import State
from sb3_hds.effects import ActionDelay, ViscousFriction
from sb3_hds.errors import CalibrationError, ModelFileError, ParameterError
from sb3_hds.twins.mujoco.engine.host import on_host
from sb3_hds.twins.mujoco.engine.simulator import Simulator
from sb3_hds.twins.mujoco.engine.values import Values

BALL_ON_A_FLOOR = """<mujoco><option timestep="0.005"/><worldbody>
  <geom type="plane" size="5 5 1"/>
  <body name="ball" pos="0 0 0.3"><freejoint name="free"/><geom size="0.1"/>
    <body name="arm" pos="0 0 0.1"><joint name="hinge" axis="0 1 0" damping="0.01"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02"/></body></body></worldbody>
  <actuator><motor joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""


def simulator_of(model, names=(), n_steps=5, n_threads=2):
    values = Values(model, names)
    return Simulator(values, np.ones(len(names)), model.opt.timestep, n_steps, n_threads=n_threads)


def rows_of(model, n, values=(), seed=0):
    """Random states near the ground, commands, no applied force."""
    rng = np.random.default_rng(seed)
    rows = np.zeros((n, model.nq + 2 * model.nv + model.nu + len(values)))
    for row in rows:
        q = model.qpos0.copy()
        mujoco.mj_integratePos(model, q, rng.normal(0.0, 0.1, model.nv), 1.0)
        row[: model.nq] = q
    rows[:, model.nq : model.nq + model.nv] = rng.normal(0.0, 0.5, (n, model.nv))
    rows[:, model.nq + model.nv : model.nq + model.nv + model.nu] = 0.3
    rows[:, rows.shape[1] - len(values) :] = values
    return rows


def half_cheetah():
    return twins.make("HalfCheetah").model


# --- callbacks


def doubled(rows):
    assert rows.dtype == np.float64 and rows.ndim == 2
    return np.concatenate([2.0 * rows, rows[:, :1]], 1)


@each(False, True)
def test_rows_reach_numpy_and_come_back_in_their_own_precision(double):
    with jax.enable_x64(double):
        x = jnp.arange(24.0).reshape(2, 3, 4) / 3.0
        for lead, rows in (((), x[0, 0]), ((3,), x[0]), ((2, 3), x)):
            call = lambda row: on_host(doubled, 5, row)  # noqa: E731
            for _ in lead:
                call = jax.vmap(call)
            found = jax.jit(call)(rows)
            assert found.dtype == rows.dtype and found.shape == (*lead, 5)
            np.testing.assert_array_equal(found, jnp.concatenate([2.0 * rows, rows[..., :1]], -1))


def test_double_precision_survives_a_callback_on_a_thread_without_it(x64):
    """A program large enough for XLA to run it on another thread, where x64 is not enabled."""
    threads = set()

    def tiny(rows):
        threads.add(threading.get_ident())
        return rows + 1e-12

    @jax.jit
    def program(x):
        def body(x, _):
            return on_host(tiny, 300, jnp.sort(x)), None

        return jax.lax.scan(body, x, None, length=50)[0]

    with jax.enable_x64(True):
        found = [program(jnp.ones(300) + k) for k in range(4)]  # several at once
    np.testing.assert_allclose(found[0] - 1.0, 50e-12, rtol=1e-3)
    assert len(threads) >= 1


def scanned(n):
    """``n`` callbacks in sequence, with matrix products that need XLA's threads between them."""

    @jax.jit
    def program(x):
        def body(x, _):
            return 0.9 * jnp.tanh(on_host(lambda_rows, 256, x) @ jnp.eye(256)), None

        return jax.lax.scan(body, x, None, length=n)[0]

    return program(jnp.ones((256,))).block_until_ready()


def lambda_rows(rows):
    return rows + 0.0


_ON_ONE_CORE = """
import os, sys
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
sys.path[:0] = %r
import jax, jax.numpy as jnp
from test_engine import scanned
from sb3_hds import twins
scanned(%d)
twin = twins.make("HalfCheetah")
@jax.jit
def fall(state):
    stay = lambda s, _: (twin.step(s, jnp.zeros(6), twin.params), None)
    return jax.lax.scan(stay, state, None, length=%d)[0]
print(float(fall(twin.initial(jax.random.key(0), twin.params)).q[1]))
"""


@each(300, pytest.param(10_000, marks=pytest.mark.expensive))
def test_many_callbacks_on_one_core_do_not_stand_still(n):
    program = _ON_ONE_CORE % (sys.path, n, n)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert -0.7 < float(done.stdout) < 0.3


def test_two_programs_at_once_wait_for_each_other(x64):
    twin = twins.make("HalfCheetah")
    starts = jax.vmap(twin.initial, (0, None))(jax.random.split(jax.random.key(0), 8), twin.params)
    step = jax.jit(jax.vmap(lambda s: twin.step(s, jnp.zeros(6), twin.params)))
    expected, found = step(starts), [None] * 4

    def work(k):
        with jax.enable_x64(True):
            for _ in range(20):
                found[k] = step(starts)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    [thread.start() for thread in threads]
    [thread.join(120) for thread in threads]
    for one in found:
        np.testing.assert_array_equal(one.v, expected.v)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore:.*fork.*")
def test_the_engine_works_in_a_forked_process():
    simulator = simulator_of(half_cheetah())
    rows = rows_of(half_cheetah(), 4)
    expected = simulator.advance(rows)
    child = os.fork()
    if child == 0:
        signal.alarm(30)  # ends it, should it wait for threads that it does not have
        os._exit(0 if np.array_equal(simulator.advance(rows), expected) else 1)
    assert os.waitpid(child, 0)[1] == 0


# --- the simulator


def test_an_interval_is_so_many_steps_of_mujoco():
    model = mujoco.MjModel.from_xml_string(BALL_ON_A_FLOOR)
    rows, data = rows_of(model, 16), mujoco.MjData(model)
    rows[:, 2] = 0.08  # pressed into the floor
    model.opt.tolerance = 1e-12

    found = simulator_of(model).advance(rows)

    touched = 0
    for row, end in zip(rows, found, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = row[: model.nq], row[model.nq : model.nq + model.nv]
        data.ctrl[:] = 0.3
        mujoco.mj_step(model, data)
        touched += data.ncon > 0
        mujoco.mj_step(model, data, 4)
        np.testing.assert_allclose(end, [*data.qpos, *data.qvel], rtol=0.0, atol=1e-13)
    assert touched == 16


def test_by_mujocos_own_and_by_our_differences_a_jacobian_is_the_same():
    model = half_cheetah()
    simulator, rows = simulator_of(model), rows_of(model, 8)
    rows[:, 1] = np.linspace(-0.1, 0.3, 8)  # in contact with the ground, and above it
    nv, n_columns = model.nv, 2 * model.nv + model.nu

    by_mujoco = simulator.linearise(rows)
    by_intervals = simulator._differences(rows, n_columns)

    np.testing.assert_allclose(by_mujoco[:, : 2 * nv], by_intervals[:, : 2 * nv], 0.0, 1e-10)
    jacobians = [x[:, 2 * nv :].reshape(8, 2 * nv, n_columns) for x in (by_mujoco, by_intervals)]
    scale = np.abs(jacobians[1]).max((1, 2), keepdims=True)
    # One-sided differences of 1e-6 at another order of the sub-steps.
    assert np.median(np.abs(jacobians[0] - jacobians[1]) / scale) < 1e-6
    assert (np.abs(jacobians[0] - jacobians[1]) / scale).max() < 1e-2


def test_other_values_make_other_models_each_for_its_row():
    model, names = half_cheetah(), ("gravity", "torso_mass")
    nominal = list(Values(model, names).read(model).values())
    rows = rows_of(model, 4, nominal)
    rows[:, 1] = 1.0  # in free fall
    rows[2, -2] = 0.0

    ends = simulator_of(model, names).advance(rows)[:, 10]

    fallen = ends - rows[:, 10]
    assert fallen[2] - fallen[0] == pytest.approx(9.81 * 0.05, abs=0.05)
    assert simulator_of(model, names)._values.model(np.array([9.81, 2.0])).body_mass[1] == 2.0


def test_what_diverges_is_nan_and_leaves_the_others_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs what it resets
    simulator, rows = simulator_of(half_cheetah()), rows_of(half_cheetah(), 4)
    alone = simulator.advance(rows[3:])
    rows[0, 3], rows[1, 12] = np.nan, 1e12

    for found in (simulator.advance(rows), simulator.linearise(rows)[:, :18]):
        assert np.isnan(found[:2]).all() and np.isfinite(found[2:]).all()
        np.testing.assert_allclose(found[3:], alone, rtol=0.0, atol=1e-12)


# --- the twin


def robot(**settings):
    return twins.from_mujoco(BALL_ON_A_FLOOR, engine="mujoco", dt=0.02, **settings)


def moving(twin, z=0.5):
    q = jnp.array([0.1, 0.2, z, 0.8, 0.1, 0.5, -0.3, 0.4])
    q = q.at[3:7].divide(jnp.linalg.norm(q[3:7]))
    return State(q, jnp.array([0.1, -0.2, 0.3, 1.0, -2.0, 0.5, 0.7]), {})


def test_derivatives_go_through_quaternions_forces_and_parameters(x64):
    twin, state = robot(), moving(robot())

    def after(change):
        params = dict(twin.values)
        params["arm_mass"] += change[15]
        params["hinge_damping"] += change[16]
        moved = twin.step(twin.retract(state, change[:14]), change[14:15], params)
        return twin.difference(moved, state)

    jacobian = jax.jit(jax.jacfwd(after))(jnp.zeros(17))
    ahead = jax.jit(jax.vmap(after))
    width = 1e-5
    difference = (ahead(width * jnp.eye(17)) - ahead(-width * jnp.eye(17))).T / (2.0 * width)

    # One-sided differences of 1e-6 in the engine, times a curvature of up to 100.
    np.testing.assert_allclose(jacobian, difference, rtol=1e-4, atol=1e-4)
    assert (np.abs(difference).max(0) > 1e-3).all()


def test_parameters_cost_columns_only_where_they_are_differentiated(monkeypatch):
    n_calls = {"linearise": 0, "linearise_more": 0}
    for name in n_calls:
        usual = getattr(Simulator, name)

        def counted(self, rows, name=name, usual=usual):
            n_calls[name] += 1
            return usual(self, rows)

        monkeypatch.setattr(Simulator, name, counted)
    # Another model, for simulators are kept.
    twin = twins.from_mujoco(BALL_ON_A_FLOOR.replace("0.005", "0.004"), engine="mujoco", dt=0.02)
    state = moving(twin)
    jax.jit(jax.jacfwd(lambda u: twin.step(state, u, twin.params).v))(jnp.zeros(1))
    assert n_calls == {"linearise": 1, "linearise_more": 0}
    with_mass = lambda m: twin.step(state, jnp.zeros(1), twin.params | {"arm_mass": m}).v  # noqa: E731
    jax.jit(jax.jacfwd(with_mass))(0.3)
    assert n_calls == {"linearise": 1, "linearise_more": 1}


def test_reverse_mode_is_the_transpose_of_forward_mode_over_several_steps(x64):
    twin, start = robot(), moving(robot(), 0.2)

    def end(actions, mass):
        params = twin.params | {"arm_mass": mass}
        step = lambda state, action: (twin.step(state, action, params), None)  # noqa: E731
        state = jax.lax.scan(step, start, actions)[0]
        return jnp.sum(state.q * jnp.arange(8.0)) + jnp.sum(state.v)

    at = jnp.full((10, 1), 0.3), 0.4
    back = jax.jit(jax.grad(end, (0, 1)))(*at)
    ahead = jax.jit(jax.jacfwd(end, (0, 1)))(*at)

    np.testing.assert_allclose(back[0], ahead[0], rtol=0.0, atol=1e-12)
    assert float(back[1]) == pytest.approx(float(ahead[1]), rel=1e-12) and abs(back[1]) > 1.0


def test_a_twin_of_a_file_survives_pickling_and_being_written_down():
    twin = robot(observe="q").with_parameters(arm_mass=0.5)

    again = twins.from_spec(json.loads(json.dumps(twin.to_spec())))
    copied = pickle.loads(pickle.dumps(twin))

    for other in (again, copied):
        assert other == twin and other.values == twin.values
        assert other.channels == twin.channels and len(twin.channels) == 8
    assert {"gravity", "friction", "ball_mass", "hinge_damping", "hinge_gain"} < set(twin.values)


@each(
    ("<general joint='hinge' dyntype='integrator'/>", "actuators with a state"),
    ("", None),
)
def test_a_model_with_more_state_than_a_twin_has_is_refused(added, message):
    text = BALL_ON_A_FLOOR.replace("</actuator>", f"{added}</actuator>")
    if message is None:
        assert twins.from_mujoco(text, engine="mujoco").dt == 0.005
        return
    with pytest.raises(ModelFileError, match=message):
        twins.from_mujoco(text, engine="mujoco")
    with pytest.raises(ParameterError, match="for engine='smooth'"):
        twins.from_mujoco(BALL_ON_A_FLOOR, engine="mujoco", masses=True)


def test_effects_act_on_the_engine(x64):
    plain = twins.make("HalfCheetah")
    state = plain.initial(jax.random.key(0), plain.params)._replace(v=jnp.full(9, 1.0))
    state = state._replace(q=state.q.at[1].set(1.0))  # nothing touches
    command = jnp.full(6, 0.5)

    def after(twin):
        start = twin.infer(twin.observe(state, twin.params), twin.params)
        for _ in range(3):
            start = jax.jit(twin.step)(start, command, twin.params)
        return np.concatenate([start.q, start.v])

    class Undamped(twins.HalfCheetah):
        native_effects = {}

    native = after(plain.extend(ViscousFriction("bthigh", b=0.5)))
    forced = after(Undamped().extend(ViscousFriction("bthigh", b=0.5)))
    # Damping is implicit in the engine, the force explicit: a few percent at this step.
    usual = after(plain)
    changed = np.abs(native - usual).max()
    assert np.abs(native - forced).max() < 0.2 * changed > 0.01
    late = plain.extend(ActionDelay("bfoot", delay=0.05))
    assert np.abs(after(late) - usual).max() > 1e-2


def test_identification_through_the_engine_is_refused_with_the_way_out():
    twin = twins.make("Swimmer")
    data = Trajectories.from_arrays([np.zeros((30, 8))], [np.zeros((29, 2))], dt=twin.dt)
    for refused in (calibrate, diagnose):
        for one in (twin, twin.extend(ViscousFriction(3))):
            with pytest.raises(CalibrationError, match=r"takes hours.*ignore=\['contacts'"):
                refused(one, data)


def test_learners_find_the_twin_of_a_task():
    model = HDS("Reacher-v5", n_rollouts=4, horizon=4, pretrain_epochs=1, lookahead=4)
    model.learn(0)
    assert type(model.twin) is twins.Reacher and model.twin_timesteps > 0
    assert model.predict(np.zeros(10, np.float32))[0].shape == (2,)


def test_planning_through_contact_moves_forward(x64):
    env = gymnasium.make("HalfCheetah-v5")
    policy = planning.mpc(twins.from_env(env), horizon=10, n_iterations=2, replan_every=2)
    (obs, _), total = env.reset(seed=0), 0.0
    for k in range(30):
        action, _ = policy.predict(obs, episode_start=np.array([k == 0]))
        obs, reward, *_ = env.step(action)
        total += reward
    # Random actions earn about -8 in 30 steps.
    assert total > 10.0
