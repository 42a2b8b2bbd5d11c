"""
Rigs on MuJoCo's C engine, with effects planted that are computed here, not by the product.

Each rig is one XML file, stepped every millisecond. Forces of effects go through MuJoCo's own
damping, dry friction and springs where it has them, and otherwise through `qfrc_applied`, which is
recomputed before each step; commands and measurements are changed on their way in and out.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

_STEP = 0.001  # [s]

_HEAD = '<mujoco><option timestep="0.001" integrator="RK4" gravity="0 0 -9.81"/>'
_PENDULUM = (
    _HEAD
    + """<worldbody><body><joint name="joint" axis="0 -1 0"/>
<inertial pos="0 0 -0.2" mass="0.5" diaginertia="0.004 0.004 0.004"/></body></worldbody>
<actuator><motor joint="joint"/></actuator></mujoco>"""
)
_CART_POLE = (
    _HEAD
    + """<worldbody><body><joint name="track" type="slide" axis="1 0 0"/>
<inertial pos="0 0 0" mass="1.0" diaginertia="0.01 0.01 0.01"/>
<body><joint name="hinge" axis="0 1 0"/>
<inertial pos="0 0 0.5" mass="0.3" diaginertia="0.025 0.025 0.001"/></body></body></worldbody>
<actuator><motor joint="track"/></actuator></mujoco>"""
)
_DOUBLE = (
    _HEAD
    + """<worldbody><body><joint name="joint1" axis="0 -1 0"/>
<inertial pos="0 0 -0.15" mass="0.5" diaginertia="0.01 0.01 0.01"/>
<body pos="0 0 -0.3"><joint name="joint2" axis="0 -1 0"/>
<inertial pos="0 0 -0.12" mass="0.4" diaginertia="0.005 0.005 0.005"/></body></body></worldbody>
<actuator><motor joint="joint1"/><motor joint="joint2"/></actuator></mujoco>"""
)
_FURUTA = (
    _HEAD
    + """<worldbody><body><joint name="arm" axis="0 0 1" damping="0.002"/>
<inertial pos="0 0 0" mass="0.1" diaginertia="6e-4 6e-4 6e-4"/>
<body pos="0.1 0 0"><joint name="pendulum" axis="1 0 0" damping="0.0002"/>
<inertial pos="0 0 -0.07" mass="0.05" diaginertia="8e-5 8e-5 1e-12"/></body></body></worldbody>
<actuator><motor joint="arm"/></actuator></mujoco>"""
)
# Motor and load apart, each with half of the inertia; a tendon holds them together. Gravity and
# friction act on the load, as `effects.Transmission` says.
_TENDON = """<tendon><fixed {hold}><joint joint="rotor" coef="1"/><joint joint="load" coef="-1"/>
</fixed></tendon><actuator><motor joint="rotor"/></actuator></mujoco>"""
_PENDULUM_APART = (
    _HEAD
    + """<worldbody><body><joint name="load" axis="0 -1 0"/>
<inertial pos="0 0 -0.1" mass="1.0" diaginertia="0.002 0.002 0.002"/></body>
<body><joint name="rotor" axis="0 -1 0"/>
<inertial pos="0 0 0" mass="0.1" diaginertia="0.012 0.012 0.012"/></body></worldbody>"""
    + _TENDON
)
_AXIS_APART = (
    _HEAD
    + """<worldbody><body><joint name="load" type="slide" axis="1 0 0" damping="3"/>
<inertial pos="0 0 0" mass="1.0" diaginertia="0.01 0.01 0.01"/></body>
<body><joint name="rotor" type="slide" axis="1 0 0"/>
<inertial pos="0 0 0" mass="1.0" diaginertia="0.01 0.01 0.01"/></body></worldbody>"""
    + _TENDON
)
_AXIS = (
    _HEAD
    + """<worldbody><body><joint name="axis" type="slide" axis="1 0 0" damping="3"/>
<inertial pos="0 0 0" mass="2.0" diaginertia="0.01 0.01 0.01"/></body></worldbody>
<actuator><motor joint="axis"/></actuator></mujoco>"""
)


@dataclass(frozen=True)
class System:
    """
    :param xml: for the engine
    :param twin: name and values of the twin that describes the same rig
    :param torque: typical command of each motor
    :param start: spread of the positions in which recordings begin
    :param dof: joints
    :param base: parameter of the twin that may be wrong, the body that it belongs to, and whether
        it is the body's mass or its inertia
    :param apart: for the engine, where motor and load are two, with a place for what holds them
    :param inertia: of the rigid joint, where that is
    """

    xml: str
    twin: tuple[str, dict[str, Any]]
    torque: tuple[float, ...]
    start: tuple[float, ...]
    base: tuple[str, int, str]
    apart: str = ""
    inertia: float = math.nan

    @property
    def dof(self) -> int:
        return len(self.start)


SYSTEMS = {
    "pendulum": System(
        _PENDULUM,
        ("FreePendulum", {"driven": True, "mass": 0.5, "com": 0.2, "inertia": 0.004}),
        (0.5,),
        (1.0,),
        ("mass", 1, "mass"),
        _PENDULUM_APART,
        0.024,
    ),
    "cart_pole": System(
        _CART_POLE,
        ("CartPole", {"gravity": 9.81, "cart_mass": 1.0, "pole_mass": 0.3, "half_length": 0.5}),
        (3.0,),
        (0.1, math.pi),
        ("cart_mass", 1, "mass"),
    ),
    "double_pendulum": System(
        _DOUBLE,
        (
            "DoublePendulum",
            {
                "mass1": 0.5,
                "mass2": 0.4,
                "length1": 0.3,
                "com1": 0.15,
                "com2": 0.12,
                "inertia1": 0.01 + 0.5 * 0.15**2,
                "inertia2": 0.005 + 0.4 * 0.12**2,
            },
        ),
        (0.4, 0.15),
        (0.5, 0.5),
        ("inertia1", 1, "inertia"),
    ),
    "furuta": System(
        _FURUTA,
        (
            "Furuta",
            {
                "arm_inertia": 6e-4,
                "arm_length": 0.1,
                "mass": 0.05,
                "com": 0.07,
                "inertia": 8e-5,
                "arm_damping": 0.002,
                "pendulum_damping": 2e-4,
            },
        ),
        (0.015,),
        (0.5, 1.0),
        ("arm_inertia", 1, "inertia"),
    ),
    "linear_axis": System(
        _AXIS,
        ("LinearAxis", {"mass": 2.0, "damping": 3.0}),
        (6.0,),
        (0.2,),
        ("mass", 1, "mass"),
        _AXIS_APART,
        2.0,
    ),
}


@dataclass
class Planted:
    """
    :param effect: name as in the catalogue, or of something that is not in it
    :param index: of the joint, the motor or the channel
    :param values: in its units
    """

    effect: str
    index: int = 0
    values: Mapping[str, float] = field(default_factory=dict)


@dataclass
class Moment:
    q: float
    v: float
    motor: float
    load: float
    time: float
    memory: dict[str, float]


def _sign(v: float) -> float:
    return math.tanh(v / 1e-3)


def _hysteresis(at: Moment, stiffness: float, slip: float) -> float:
    """A bristle that bends with the motion and slips (Dahl)."""
    bent = at.memory.get("bent", 0.0)
    at.memory["bent"] = float(np.clip(bent + at.v * _STEP, -slip, slip))
    return -stiffness * at.memory["bent"]


FORCES: dict[str, Callable[..., float]] = {
    "directional_viscous_friction": lambda at, b_pos, b_neg: -(b_pos if at.v > 0 else b_neg) * at.v,
    "directional_coulomb_friction": lambda at, tau_pos, tau_neg: (
        -(tau_pos if at.v > 0 else tau_neg) * abs(_sign(at.v)) * np.sign(at.v)
    ),
    "stribeck_friction": lambda at, tau_c, tau_s, v_s: (
        -_sign(at.v) * (tau_c + (tau_s - tau_c) * math.exp(-((at.v / v_s) ** 2)))
    ),
    "load_dependent_friction": lambda at, tau_c, mu: (
        -_sign(at.v) * (tau_c + mu * abs(at.motor + at.load))
    ),
    "quadratic_drag": lambda at, c: -c * at.v * abs(at.v),
    "cubic_stiffness": lambda at, k3: -k3 * at.q**3,
    "cogging": lambda at, amplitude, period, phase: (
        amplitude * math.sin(2.0 * math.pi * at.q / period + phase)
    ),
    "constant_force": lambda at, tau_0: tau_0,
    # Not in the catalogue:
    "position_dependent_friction": lambda at, tau_c, period: (
        -_sign(at.v) * tau_c * (1.0 + math.sin(2.0 * math.pi * at.q / period))
    ),
    "hysteresis": _hysteresis,
    "thermal_drift": lambda at, rate: rate * at.time * at.v,
    "soft_impact": lambda at, k, wall: -k * max(at.q - wall, 0.0),
    "cable_spring": lambda at, k, slack: -k * np.sign(at.q) * max(abs(at.q) - slack, 0.0),
}
OUTSIDE = (
    "position_dependent_friction",
    "hysteresis",
    "thermal_drift",
    "soft_impact",
    "cable_spring",
)


class Commands:
    """What happens to a command on its way in."""

    def __init__(self, planted: list[Planted]) -> None:
        self.planted, self.lagged, self.past = planted, {}, {}

    def __call__(self, index: int, u: float) -> float:
        for p in self.planted:
            if p.index != index:
                continue
            v = p.values
            if p.effect == "torque_gain":
                u *= v["gain"]
            elif p.effect == "directional_gain":
                u *= v["gain_pos"] if u > 0 else v["gain_neg"]
            elif p.effect == "dead_zone":
                u = math.copysign(max(abs(u) - 0.5 * v["width"], 0.0), u)
            elif p.effect == "saturation":
                u = float(np.clip(u, -v["limit"], v["limit"]))
            elif p.effect == "motor_lag":
                share = 1.0 - math.exp(-_STEP / v["time_constant"])
                self.lagged[index] = u = (
                    self.lagged.get(index, 0.0) + (u - self.lagged.get(index, 0.0)) * share
                )
            elif p.effect == "action_delay":
                queue = self.past.setdefault(index, [0.0] * round(v["delay"] / _STEP))
                queue.append(u)
                u = queue.pop(0)
        return u


COMMANDS = (
    "torque_gain",
    "directional_gain",
    "dead_zone",
    "saturation",
    "motor_lag",
    "action_delay",
)
TRANSMISSIONS: dict[str, Callable[..., str]] = {
    "joint_elasticity": lambda k, d: f'stiffness="{k}" damping="{d}"',
    "backlash": lambda gap: (
        f'limited="true" range="{-0.5 * gap} {0.5 * gap}" solreflimit="0.002 1"'
    ),
}
SENSORS = ("sensor_bias", "sensor_scale", "sensor_delay", "sign_flip")


def simulate(
    system: System,
    planted: list[Planted],
    *,
    dt: float,
    n_recordings: int,
    n_steps: int,
    seed: int,
    wrong_base: float = 1.0,
    disturbance: float = 0.0,
    excited: bool = True,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """
    :param wrong_base: factor by which a mass is not what the twin believes
    :param disturbance: standard deviation of a coloured torque (correlated over 0.1 s), in units of
        the typical command
    :return: noiseless observations and commands of each recording
    """
    xml = system.xml
    for p in planted:
        if p.effect in TRANSMISSIONS:
            xml = system.apart.format(hold=TRANSMISSIONS[p.effect](**p.values))
    model = mujoco.MjModel.from_xml_string(xml)
    _, body, what = system.base
    getattr(model, f"body_{what}")[body] *= wrong_base
    # The engine keeps inertias of simple joints from when it read the file.
    mujoco.mj_setConst(model, mujoco.MjData(model))
    for p in planted:
        if p.effect == "viscous_friction":
            model.dof_damping[p.index] += p.values["b"]
        elif p.effect == "coulomb_friction":
            model.dof_frictionloss[p.index] += p.values["tau_c"]
        elif p.effect == "stiffness":
            model.jnt_stiffness[p.index] = p.values["k"]
            model.qpos_spring[p.index] = p.values["q0"]
    rng = np.random.default_rng(seed)
    per_step = round(dt / _STEP)
    found = [
        _recording(model, system, planted, rng, per_step, n_steps, disturbance, excited)
        for _ in range(n_recordings)
    ]
    return [obs for obs, _ in found], [actions for _, actions in found]


def _recording(
    model: Any,
    system: System,
    planted: list[Planted],
    rng: np.random.Generator,
    per_step: int,
    n_steps: int,
    disturbance: float,
    excited: bool,
) -> tuple[np.ndarray, np.ndarray]:
    data = mujoco.MjData(model)
    if excited:
        # A motor that is apart begins where its load does.
        data.qpos[:] = rng.uniform(-1.0, 1.0, system.dof) * np.array(system.start)
    n_motors = len(system.torque)
    wander = rng.standard_normal((n_steps, n_motors)).cumsum(0) * 0.7
    actions = np.sin(wander + rng.uniform(0.0, 6.0, n_motors)) * np.array(system.torque)
    actions = actions if excited else np.zeros_like(actions)
    commands = Commands([p for p in planted if p.effect in COMMANDS])
    forces = [(p, {}) for p in planted if p.effect in FORCES]
    rows, fine, push = [_state(data, system)], [_state(data, system)], np.zeros(system.dof)
    size = disturbance * np.array([*system.torque, *system.torque])[: system.dof]
    keep = math.exp(-_STEP / 0.1)
    for action in actions:
        for _ in range(per_step):
            data.ctrl[:] = [commands(i, u) for i, u in enumerate(action)]
            push = keep * push + math.sqrt(1.0 - keep**2) * size * rng.standard_normal(system.dof)
            data.qfrc_applied[: system.dof] = push if disturbance else 0.0
            for p, memory in forces:
                i = p.index
                motor = data.ctrl[i] if i < n_motors else 0.0
                at = Moment(data.qpos[i], data.qvel[i], motor, data.qfrc_bias[i], data.time, memory)
                data.qfrc_applied[i] += FORCES[p.effect](at, **p.values)
            mujoco.mj_step(model, data)
            fine.append(_state(data, system))
        rows.append(_state(data, system))
    obs, fine = np.array(rows), np.array(fine)
    for p in planted:
        j = p.index
        if p.effect == "sensor_bias":
            obs[:, j] += p.values["bias"]
        elif p.effect == "sensor_scale":
            obs[:, j] *= p.values["scale"]
        elif p.effect == "sign_flip":
            obs[:, j] *= -1.0
        elif p.effect == "sensor_delay":
            late = np.arange(len(obs)) * per_step - round(p.values["delay"] / _STEP)
            obs[:, j] = fine[np.maximum(late, 0), j]
    return obs, actions


def _state(data: Any, system: System) -> np.ndarray:
    return np.concatenate([data.qpos[: system.dof], data.qvel[: system.dof]])
