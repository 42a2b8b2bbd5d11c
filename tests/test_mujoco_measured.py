"""Robots that others measured, from their URDF through the command line."""

import json
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from sb3_hds import cli, effects, twins
from sb3_hds.core import rollout
from sb3_hds.data.columns import Columns
from sb3_hds.data.reading import read_log
from sb3_hds.sysid.motion.smoothing import smooth

pytestmark = [
    pytest.mark.measured,
    pytest.mark.skipif("SB3_HDS_DATA" not in os.environ, reason="data outside the repository"),
]
UR10 = Path(os.environ.get("SB3_HDS_DATA", "."), "ur10")
# Of SOURCE.txt: least squares on inverse dynamics, accelerations by a Savitzky-Golay filter.
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
COULOMB = (12.7, 14.7, 8.4, 2.9, 2.5, 3.0)  # [N m]
VISCOUS = (19.2, 22.7, 8.6, 3.2, 3.0, 3.0)  # [N m s/rad]
TRAINED, STEPS = 2400, 25
# At which friction is compared where it is concave: what the arm's joints reach in all [rad/s].
SPEED = 0.5


BAG = UR10 / "ur10_exciting_trajectory.db3"


def calibrated(folder, log):
    words = [
        *("calibrate", "--model", UR10 / "ur10.urdf", "--data", log, "--errors", "force"),
        *("--free", "*_damping", "*_frictionloss"),
        *("--json", folder / "fit.json", "--write", folder / "corrected.xml"),
    ]
    assert cli.main([str(word) for word in words]) == 0
    return json.loads((folder / "fit.json").read_text())


@pytest.fixture(scope="module")
def ur10(tmp_path_factory):
    """Calibrated on the first 19 s of 27.5: the twin, the corrected file, and all signals."""
    folder = tmp_path_factory.mktemp("ur10")
    table = read_log(BAG, Columns()).tables[0]
    names = [name for name in table if "[" in name or "stamp" in name]
    rows = np.stack([table[name] for name in names], 1)[:TRAINED]
    np.savetxt(folder / "a.csv", rows, "%.9f", ",", header=",".join(names), comments="")
    told = calibrated(folder, folder / "a.csv")
    signals = {
        kind: np.stack([table[f"/joint_states:{kind}[{j}_joint]"] for j in JOINTS], 1)
        for kind in ("position", "velocity", "effort")
    }
    return twins.from_spec(told["twin"], ()), folder / "corrected.xml", signals


def test_friction_of_a_ur10_is_that_of_its_publishers_within_a_quarter(tmp_path):
    found = {e["name"]: e["estimate"] for e in calibrated(tmp_path, BAG)["estimates"]}
    for joint, coulomb, viscous in zip(JOINTS, COULOMB, VISCOUS, strict=True):
        assert found[f"{joint}_joint_frictionloss"] == pytest.approx(coulomb, rel=0.25)
        assert found[f"{joint}_joint_damping"] == pytest.approx(viscous, rel=0.25)


@pytest.mark.expensive
def test_a_diagnosis_of_a_ur10_names_the_friction_of_all_six_joints(tmp_path):
    words = ["diagnose", "--model", UR10 / "ur10.urdf", "--data", BAG, "--budget", "quick"]
    assert cli.main([*map(str, words), "--json", str(tmp_path / "found.json")]) == 0
    told = json.loads((tmp_path / "found.json").read_text())
    friction, offsets = {joint: 0.0 for joint in JOINTS}, set()
    for f in told["findings"]:
        values = [p["estimate"] for p in f["parameters"].values()]
        joint = f["where"]["name"].removesuffix("_joint")
        if f["effect"] == "concave_friction":
            friction[joint] += values[0] * SPEED / (1.0 + SPEED / values[1])
        elif f["effect"] == "constant_force":
            offsets.add(joint)
        elif f["effect"] in ("viscous_friction", "coulomb_friction"):
            friction[joint] += values[0] * (SPEED if f["effect"] == "viscous_friction" else 1.0)

    for joint, coulomb, viscous in zip(JOINTS, COULOMB, VISCOUS, strict=True):
        assert friction[joint] == pytest.approx(coulomb + viscous * SPEED, rel=0.25)
    # With masses free, least squares on inverse dynamics give wrist 1 one of 0.7 N m, too.
    assert offsets == {"wrist_1", "wrist_2", "wrist_3"}
    assert told["sentence"].startswith("All six joints have friction that the model lacks")


def test_its_corrected_file_predicts_held_out_seconds_as_well_as_the_twin(ur10, x64):
    """Windows of 0.2 s from measured states, in units of what each joint moves in them."""
    corrected, file, signals = ur10
    q, v, effort = (signals[kind] for kind in ("position", "velocity", "effort"))
    v = np.stack([smooth(q[:, j], v[:, j], 0.008).v for j in range(6)], 1)
    begins = np.arange(TRAINED, len(q) - STEPS - 1, STEPS)
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    nominal = twins.from_mujoco(UR10 / "ur10.urdf", dt=0.008)

    def of(twin):
        params = {name: jnp.asarray(value, jnp.float64) for name, value in twin.values.items()}

        def one(start, actions):
            return rollout(twin, params, twin.infer(start, params), actions).obs

        actions = np.stack([effort[k : k + STEPS] for k in begins])
        starts = np.concatenate([q[begins], v[begins]], 1)
        return np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(starts), jnp.asarray(actions)))

    def stepped(k):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = q[k], v[k]
        seen = []
        for action in effort[k : k + STEPS]:
            data.ctrl[:] = action
            for _ in range(corrected.substeps):
                mujoco.mj_step(model, data)
            seen.append(data.qpos.copy())
        return seen

    measured = np.stack([q[k + 1 : k + 1 + STEPS] for k in begins])
    scale = np.std(measured - q[begins][:, None], (0, 1))
    error = lambda found: np.sqrt(np.mean(((found - measured) / scale) ** 2))  # noqa: E731
    ours, before = (error(of(twin)[:, 1:, :6]) for twin in (corrected, nominal))
    theirs = error(np.array([stepped(k) for k in begins]))

    assert ours < 0.5 < before and theirs < 1.1 * ours


GO2 = UR10.parent / "go2"
PARTS = ("hip", "thigh", "calf")
LEGS = [f"{leg}_{part}_joint" for leg in ("FL", "FR", "RL", "RR") for part in PARTS]
MAP = {
    "time": "time",
    "obs": [{"column": f"position[{i}]", "name": f"{j}_position"} for i, j in enumerate(LEGS)],
    "actions": [{"column": f"target[{i}]", "name": j} for i, j in enumerate(LEGS)],
}


@pytest.mark.expensive
def test_a_quadruped_s_loop_is_calibrated_and_its_file_steps_held_out_seconds_better(tmp_path):
    """Of positions alone; half seconds from measured states, in the C engine."""
    log = np.load(GO2 / "traj_0.npz")
    time, q, target = (log[name] for name in ("time", "position", "target"))
    np.savez(tmp_path / "a.npz", time=time[:3200], position=q[:3200], target=target[:3200])
    (tmp_path / "map.yml").write_text(json.dumps(MAP))
    kinds = [f"*_{part}_joint_{word}" for part in PARTS for word in ("damping", "frictionloss")]
    words = ["calibrate", "--model", GO2 / "go2.urdf", "--data", tmp_path / "a.npz"]
    words += ["--columns", tmp_path / "map.yml", "--actuators", "position", "kp:20", "kv:1.5"]
    words += ["--free", "*_damping", "*_frictionloss", "--tied", *kinds, "--windows", 16]

    assert cli.main([*map(str, words), "--write", str(tmp_path / "corrected.xml")]) == 0

    model = mujoco.MjModel.from_xml_path(str(tmp_path / "corrected.xml"))
    v = np.gradient(q, 0.005, axis=0)
    found = {"corrected": [], "nominal": []}
    for name, seen in found.items():
        if name == "nominal":
            model.dof_frictionloss[:], model.dof_damping[:] = 0.0, 0.0
        data = mujoco.MjData(model)
        for k in range(3200, len(q) - 101, 100):
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = q[k], v[k]
            for step in range(100):
                data.ctrl[:] = target[k + step]
                for _ in range(round(0.005 / model.opt.timestep)):
                    mujoco.mj_step(model, data)
                seen.append(data.qpos - q[k + step + 1])
    before, after = (np.sqrt(np.mean(np.square(found[name]))) for name in ("nominal", "corrected"))

    assert after < 0.5 * before


def half_second_errors(twin, q, target, warm=6):
    """
    Root mean square over half seconds [mrad], from positions and differences of positions of the
    log; commands before a window are played first, so that what is late has its past.
    """
    v, steps = np.gradient(q, 0.005, axis=0), 100
    begins = np.arange(20, len(q) - steps - 1, steps)
    params = {name: jnp.asarray(value, jnp.float64) for name, value in twin.values.items()}

    def one(before, past, position, velocity, actions):
        state = rollout(twin, params, twin.infer(before, params), past).states
        state = jax.tree.map(lambda leaf: leaf[-1], state)
        state = state._replace(q=position, v=velocity)
        return rollout(twin, params, state, actions).states.q

    given = (
        q[begins - warm],
        np.stack([target[k - warm : k] for k in begins]),
        q[begins],
        v[begins],
        np.stack([target[k : k + steps] for k in begins]),
    )
    found = np.asarray(jax.jit(jax.vmap(one))(*map(jnp.asarray, given)))[:, 1:]
    measured = np.stack([q[k + 1 : k + 1 + steps] for k in begins])
    return 1e3 * np.sqrt(np.mean((found - measured) ** 2))


# Twelve joints at 200 Hz: six minutes on one core.
@pytest.mark.expensive
@pytest.mark.timeout(3600)
def test_a_diagnosis_of_a_quadruped_names_delay_and_friction_from_positions_alone(tmp_path, x64):
    log = np.load(GO2 / "traj_0.npz")
    (tmp_path / "map.yml").write_text(json.dumps(MAP))
    words = ["diagnose", "--model", GO2 / "go2.urdf", "--data", GO2 / "traj_0.npz"]
    words += ["--columns", tmp_path / "map.yml", "--actuators", "position", "kp:20", "kv:1.5"]
    words += ["--budget", "quick", "--json", tmp_path / "found.json"]

    assert cli.main([*map(str, words)]) == 0

    told = json.loads((tmp_path / "found.json").read_text())
    late = [f for f in told["findings"] if f["effect"] in ("action_delay", "motor_lag")]
    rubbing = {f["where"]["name"] for f in told["findings"] if "friction" in f["effect"]}
    assert [f["where"]["name"] for f in late] == ["all"] and rubbing == set(LEGS)
    nominal, found = (twins.from_spec(told[name], effects.KNOWN) for name in ("believed", "twin"))
    assert half_second_errors(nominal, log["position"], log["target"]) > 28.0
    assert half_second_errors(found, log["position"], log["target"]) < 11.0
