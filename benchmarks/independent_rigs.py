"""
Rigs on MuJoCo's C engine, with planted effects that this file computes by itself.

Each rig is one XML file, stepped every millisecond. Forces of effects use MuJoCo's own damping, dry
friction and springs where it has them, and otherwise `qfrc_applied`, which is recomputed before
each step; effects of actuators and sensors change commands and measurements. Parameters have the
meaning that the catalogue gives them; the computation is separate.
"""

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import mujoco
import numpy as np

_STEP = 0.001  # [s]
#: how the names of parameters end that are the inertia of a joint's rotor
ARMATURE = "_armature"
#: index of an effect that all motors share, such as a late bus
EVERYWHERE = -1
# Number of sines in a set point, and the range of their frequencies [Hz].
_SINES, _SLOWEST, _FASTEST = 3, 0.2, 1.2
# The engine's dry friction is a damper up to where it brakes at this time constant [s] and ratio.
# Its default of 20 ms would let rigs creep: these are the hardest that its step bears.
_DRY = (2.0 * _STEP, 1.0)
# A recording with a larger value in any channel has diverged.
_TOO_FAR = 1e4

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
# The rod of Gymnasium's Pendulum-v1, which hangs at pi.
_ROD = (
    _HEAD.replace("9.81", "10")
    + """<worldbody><body><joint name="hinge" axis="0 1 0"/>
<inertial pos="0 0 0.5" mass="1.0" diaginertia="0.08333333333333333 0.08333333333333333 1e-12"/>
</body></worldbody><actuator><motor joint="hinge"/></actuator></mujoco>"""
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
        it grows with the body's mass or with its inertia, one to one; None where none is
    :param apart: for the engine, where motor and load are two, with a place for what holds them
    :param inertia: of the rigid joint, where that is
    :param damped: whether the twin has viscous friction of its own, which counts as load
    :param dt: interval of the recordings [s]
    :param rest: positions around which recordings begin; default: zero
    :param seen: from positions and velocities, shape ``(n, 2 dof)``, to what is measured
    """

    xml: str
    twin: tuple[str, dict[str, Any]]
    torque: tuple[float, ...]
    start: tuple[float, ...]
    base: tuple[str, int, str] | None = None
    apart: str = ""
    inertia: float = math.nan
    damped: bool = True
    dt: float = 0.02
    rest: tuple[float, ...] = ()
    seen: Callable[[np.ndarray], np.ndarray] = np.asarray

    @property
    def dof(self) -> int:
        return len(self.start)

    @functools.cached_property
    def around(self) -> np.ndarray:
        return np.array(self.rest or (0.0,) * self.dof)


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
        (
            "CartPole",
            {
                "observe": "qv",
                "substeps": 1,
                "gravity": 9.81,
                "cart_mass": 1.0,
                "pole_mass": 0.3,
                "half_length": 0.5,
            },
        ),
        (3.0,),
        (0.1, math.pi),
        ("cart_mass", 1, "mass"),
        damped=False,
    ),
    "double_pendulum": System(
        _DOUBLE,
        (
            "DoublePendulum",
            {
                "substeps": 1,
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
#: Pendulum-v1 in continuous time, for its twin with semi-implicit Euler steps: friction is a wrong
#: name for the difference
EULER = System(
    _ROD,
    ("Pendulum", {}),
    (1.5,),
    (1.0,),
    ("mass", 1, "mass"),
    dt=0.05,
    rest=(math.pi,),
    seen=lambda rows: np.stack([np.cos(rows[:, 0]), np.sin(rows[:, 0]), rows[:, 1]], 1),
)

_BODIES = """<default><geom contype="0" conaffinity="0" density="1000"/></default>
<worldbody><body name="base" pos="0 0 2">{}</body></worldbody>"""


def _hanging(links: list[tuple[str, float, str]]) -> str:
    """Capsules of 20 mm, one below the other: axis, length [m], and what the joint has."""
    opening, way = "", 0.0
    for i, (axis, length, words) in enumerate(links):
        opening += f'''<body name="link{i}" pos="0 0 {-way}"><joint name="joint{i}" axis="{axis}"
{words}/><geom type="capsule" fromto="0 0 0 0.01 0.01 {-length}" size="0.02"/>'''
        way = length
    return _BODIES.format(opening + "</body>" * len(links))


_ARM = _hanging(
    [
        ("0 0 1", 0.1, 'damping="0.3" armature="0.05"'),
        ("0 1 0", 0.3, 'damping="0.3" armature="0.05"'),
        ("0 1 0", 0.25, 'damping="0.2" armature="0.03"'),
        ("0 0 1", 0.1, 'damping="0.05" armature="0.01"'),
        ("0 1 0", 0.1, 'damping="0.05" armature="0.01"'),
        ("1 0 0", 0.1, 'damping="0.05" armature="0.01"'),
    ]
)
_LEG = _hanging(
    [
        ("1 0 0", 0.08, 'damping="0.1" armature="0.01"'),
        ("0 1 0", 0.2, 'damping="0.1" armature="0.01"'),
        ("0 1 0", 0.2, 'damping="0.1" armature="0.01"'),
    ]
)


def _driven(bodies: str, gains: tuple[float, ...]) -> str:
    """With motors, or with servos of these stiffnesses, damped as a motor controller is."""
    n = bodies.count("<joint ")
    drives = [f'<motor name="motor{i}" joint="joint{i}"/>' for i in range(n)]
    if gains:
        drives = [
            f'<position name="motor{i}" joint="joint{i}" kp="{kp}" kv="{0.05 * kp}"/>'
            for i, kp in enumerate(gains)
        ]
    return f"{_HEAD}{bodies}<actuator>{''.join(drives)}</actuator></mujoco>"


_ARM_TORQUES, _LEG_TORQUES = (0.6, 1.2, 0.8, 0.1, 0.15, 0.1), (0.5, 0.6, 0.3)
_ARM_GAINS, _LEG_GAINS = (20.0, 40.0, 30.0, 6.0, 6.0, 6.0), (20.0, 20.0, 20.0)
#: rigs whose twins come from their model files: each driven by torques, and by servos
FROM_FILES = {
    name: System(
        _driven(bodies, gains),
        ("MuJoCo", {}),
        tuple(0.4 for _ in gains) or torques,
        tuple(0.3 for _ in torques),
    )
    for name, bodies, torques, gains in (
        ("arm", _ARM, _ARM_TORQUES, ()),
        ("arm_servos", _ARM, _ARM_TORQUES, _ARM_GAINS),
        ("leg", _LEG, _LEG_TORQUES, ()),
        ("leg_servos", _LEG, _LEG_TORQUES, _LEG_GAINS),
    )
}


class DivergedError(RuntimeError):
    """The planted effects make the rig diverge."""


@dataclass(frozen=True)
class Planted:
    """
    :param effect: name as in the catalogue, or of something that is not in it; ``reversed_joint``
        is a sign flip of all that measures a joint
    :param index: of the joint, the motor or the channel; of all motors: ``EVERYWHERE``
    :param values: in its units
    """

    effect: str
    index: int = 0
    values: Mapping[str, float] = field(default_factory=dict)


@dataclass
class Moment:
    """
    :param motor: force of the motor on this joint
    :param load: what gravity, Coriolis forces and the rig's own damping put on it
    """

    q: float
    v: float
    motor: float
    load: float
    time: float
    memory: dict[str, float]


def _sign(v: float) -> float:
    return math.tanh(v / 1e-3)


def _hysteresis(at: Moment, stiffness: float, slip: float) -> float:
    """Friction of a bristle that bends with the motion, and slips more the more it bends (Dahl)."""
    bent = at.memory.get("bent", 0.0)
    at.memory["bent"] = bent + _STEP * (at.v - abs(at.v) * bent / slip)
    return -stiffness * at.memory["bent"]


FORCES: dict[str, Callable[..., float]] = {
    "directional_viscous_friction": lambda at, b_pos, b_neg: -(b_pos if at.v > 0 else b_neg) * at.v,
    "directional_coulomb_friction": lambda at, tau_pos, tau_neg: (
        -(tau_pos if at.v > 0 else tau_neg) * abs(_sign(at.v)) * np.sign(at.v)
    ),
    "stribeck_friction": lambda at, tau_c, tau_s, v_s: (
        -_sign(at.v) * (tau_c + (tau_s - tau_c) * math.exp(-((at.v / v_s) ** 2)))
    ),
    "concave_friction": lambda at, b, v_s: -b * at.v / (1.0 + abs(at.v) / v_s),
    "load_dependent_friction": lambda at, tau_c, mu: (
        -_sign(at.v) * (tau_c + mu * abs(at.motor + at.load))
    ),
    "quadratic_drag": lambda at, c: -c * at.v * abs(at.v),
    "cubic_stiffness": lambda at, k3: -k3 * at.q**3,
    "cogging": lambda at, amplitude, period, phase: (
        -amplitude * math.sin(2.0 * math.pi * (at.q - phase) / period)
    ),
    "constant_force": lambda at, tau_0: tau_0,
    # Not in the catalogue:
    "position_dependent_friction": lambda at, tau_c, period: (
        -_sign(at.v) * tau_c * (1.0 + math.sin(2.0 * math.pi * at.q / period))
    ),
    "hysteresis": _hysteresis,
    "thermal_drift": lambda at, rate: rate * at.time * at.v,
    # A ball against a flat wall (Hertz).
    "soft_impact": lambda at, k, wall: -k * max(at.q - wall, 0.0) ** 1.5,
    "cable_spring": lambda at, k, slack: -k * np.sign(at.q) * max(abs(at.q) - slack, 0.0),
}
OUTSIDE = (
    "position_dependent_friction",
    "hysteresis",
    "thermal_drift",
    "soft_impact",
    "cable_spring",
)


# In the order in which they act on a command.
COMMANDS = (
    "action_delay",
    "dead_zone",
    "torque_gain",
    "directional_gain",
    "saturation",
    "motor_lag",
)


class Commands:
    """Apply the effects of an actuator to its command."""

    def __init__(self, planted: list[Planted]) -> None:
        mine = (p for p in planted if p.effect in COMMANDS)
        self.planted = sorted(mine, key=lambda p: COMMANDS.index(p.effect))
        self.lagged, self.past = {}, {}

    def __call__(self, index: int, u: float) -> float:
        for p in self.planted:
            if p.index not in (index, EVERYWHERE):
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
                before, slow = self.lagged.get(index, 0.0), v["time_constant"]
                kept = math.exp(-_STEP / slow)
                self.lagged[index] = u + (before - u) * kept
                # What the motor does over the step, not where it arrives.
                u += (before - u) * (1.0 - kept) * slow / _STEP
            elif p.effect == "action_delay":
                queue = self.past.setdefault(index, [0.0] * round(v["delay"] / _STEP))
                queue.append(u)
                u = queue.pop(0)
        return u


class Loop(NamedTuple):
    """
    A controller that turns measurements into torques, held over each interval.

    :param stiffness: torque per error of position of each motor's joint; zero where velocities are
        controlled
    :param damping: torque per error of velocity
    :param amplitude: of the set points of positions; those of velocities are their derivatives
    :param sense: from the number of a recording, that of an interval, and what sensors without
        noise would show, to what they report
    """

    stiffness: np.ndarray
    damping: np.ndarray
    amplitude: np.ndarray
    sense: Callable[[int, Any, np.ndarray], np.ndarray] = lambda _, __, true: true

    def set_points(self, rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
        """:return: of positions and velocities, shape ``(2, n, motors)``"""
        shape = (_SINES, 1, len(self.amplitude))
        rate = 2.0 * math.pi * np.exp(rng.uniform(math.log(_SLOWEST), math.log(_FASTEST), shape))
        phase = rate * times[:, None] + rng.uniform(0.0, 2.0 * math.pi, shape)
        size = self.amplitude / math.sqrt(_SINES)
        return size * np.stack([np.sin(phase).sum(0), (rate * np.cos(phase)).sum(0)])

    def command(self, wanted: np.ndarray, reported: np.ndarray) -> np.ndarray:
        """
        :param wanted: position and velocity of each motor's joint, shape ``(2, motors)``
        :param reported: positions and velocities of all joints, one after the other
        """
        q, v = (x[: len(self.damping)] for x in np.split(reported, 2))
        return self.stiffness * (wanted[0] - q) + self.damping * (wanted[1] - v)


TRANSMISSIONS: dict[str, Callable[..., str]] = {
    "joint_elasticity": lambda k, d: f'stiffness="{k}" damping="{d}"',
    "backlash": lambda gap: (
        f'limited="true" range="{-0.5 * gap} {0.5 * gap}" solreflimit="0.002 1"'
    ),
}
SENSORS = ("sensor_bias", "sensor_scale", "sensor_delay", "sign_flip", "reversed_joint")


def can_change(system: System, change: float) -> bool:
    """:return: whether the inertia of the body of ``base`` is physical after this change"""
    if system.base is None:
        return change == 0.0
    _, body, what = system.base
    there = getattr(mujoco.MjModel.from_xml_string(system.xml), f"body_{what}")[body]
    return bool(np.min(there) + change > 0.1 * np.min(there))


def simulate(
    system: System,
    planted: list[Planted],
    *,
    n_recordings: int,
    n_steps: int,
    seed: int,
    base_change: float = 0.0,
    disturbance: float = 0.0,
    excited: bool = True,
    loop: Loop | None = None,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """
    :param base_change: by how much the parameter that ``base`` names is not what the twin believes
    :param disturbance: standard deviation of a coloured torque (correlated over 0.1 s), in units of
        the typical command
    :param loop: that closes itself over what is measured, noise included; no sensor may be late
        then. Default: commands are what nobody computes from measurements
    :return: noiseless observations and commands of each recording
    :raises DivergedError: if what was planted throws the rig out of the world
    """
    model = modelled(system, planted, base_change)
    rng = np.random.default_rng(seed)
    found = [
        _recording(
            model,
            system,
            planted,
            rng,
            n_steps,
            disturbance,
            excited,
            loop and loop._replace(sense=functools.partial(loop.sense, recording)),
        )
        for recording in range(n_recordings)
    ]
    return [system.seen(obs) for obs, _ in found], [actions for _, actions in found]


def modelled(system: System, planted: list[Planted], base_change: float = 0.0) -> Any:
    """:return: the engine's model, with those planted effects that it supports itself"""
    xml = system.xml
    for p in planted:
        if p.effect in TRANSMISSIONS:
            xml = system.apart.format(hold=TRANSMISSIONS[p.effect](**p.values))
    model = mujoco.MjModel.from_xml_string(xml)
    if system.base is not None:
        _, body, what = system.base
        getattr(model, f"body_{what}")[body] += base_change
    model.dof_solref[:] = _DRY
    for p in planted:
        if p.effect == "viscous_friction":
            model.dof_damping[p.index] += p.values["b"]
        elif p.effect == "coulomb_friction":
            model.dof_frictionloss[p.index] += p.values["tau_c"]
        elif p.effect == "stiffness":
            model.jnt_stiffness[p.index] = p.values["k"]
            model.qpos_spring[p.index] = p.values["q0"]
        elif p.effect.endswith(ARMATURE):
            (change,) = p.values.values()
            model.dof_armature[p.index] += change
    # The engine keeps inertias of simple joints from when it read the file.
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _recording(
    model: Any,
    system: System,
    planted: list[Planted],
    rng: np.random.Generator,
    n_steps: int,
    disturbance: float,
    excited: bool,
    loop: Loop | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """:param loop: of this recording: ``sense`` needs no number of it any more"""
    data = mujoco.MjData(model)
    data.qpos[:] = system.around
    if excited:
        # A motor that is apart begins where its load does.
        data.qpos[:] += rng.uniform(-1.0, 1.0, system.dof) * np.array(system.start)
    mujoco.mj_forward(model, data)
    n_motors = len(system.torque)
    wander = rng.standard_normal((n_steps, n_motors)).cumsum(0) * 0.7
    actions = np.sin(wander + rng.uniform(0.0, 6.0, n_motors)) * np.array(system.torque)
    actions = actions if excited else np.zeros_like(actions)
    commands, forces = Commands(planted), [(p, {}) for p in planted if p.effect in FORCES]
    fine, push = [_state(data, system)], np.zeros(system.dof)
    size = disturbance * np.array([*system.torque, *system.torque])[: system.dof]
    keep, per_step = math.exp(-_STEP / 0.1), round(system.dt / _STEP)
    wanted = loop and loop.set_points(rng, system.dt * np.arange(n_steps))
    for k, action in enumerate(actions):
        if loop is not None:
            shown = _measured(np.array(fine[-1:]), planted, system, 1)[0]
            action[:] = loop.command(wanted[:, k], loop.sense(k, shown))
        for _ in range(per_step):
            data.ctrl[:] = [commands(i, u) for i, u in enumerate(action)]
            push = keep * push + math.sqrt(1.0 - keep**2) * size * rng.standard_normal(system.dof)
            data.qfrc_applied[: system.dof] = push if disturbance else 0.0
            for p, memory in forces:
                at = _moment(model, data, system, p.index, memory)
                data.qfrc_applied[p.index] += FORCES[p.effect](at, **p.values)
            mujoco.mj_step(model, data)
            fine.append(_state(data, system))
    fine = np.array(fine)
    # The engine starts again from rest where it cannot go on.
    if data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number or np.abs(fine).max() > _TOO_FAR:
        raise DivergedError(", ".join(p.effect for p in planted))
    return _measured(fine, planted, system, per_step), actions


def _moment(model: Any, data: Any, system: System, i: int, memory: dict[str, float]) -> Moment:
    motor = data.ctrl[i] if i < len(system.torque) else 0.0
    if system.base is None:
        motor = data.qfrc_actuator[i]
    own = model.dof_damping[i] * data.qvel[i] if system.damped else 0.0
    return Moment(data.qpos[i], data.qvel[i], motor, data.qfrc_bias[i] + own, data.time, memory)


def _measured(
    fine: np.ndarray, planted: list[Planted], system: System, per_step: int
) -> np.ndarray:
    """Apply the effects of sensors to the motion: delays first, then errors."""
    obs = fine[::per_step].copy()
    for p in (p for p in planted if p.effect == "sensor_delay"):
        late = np.arange(len(obs)) * per_step - round(p.values["delay"] / _STEP)
        obs[:, p.index] = fine[np.maximum(late, 0), p.index]
    turned = {"sign_flip": (0,), "reversed_joint": (0, system.dof)}
    for p in (p for p in planted if p.effect in turned):
        obs[:, [p.index + further for further in turned[p.effect]]] *= -1.0
    for p in (p for p in planted if p.effect == "sensor_scale"):
        obs[:, p.index] *= p.values["scale"]
    for p in (p for p in planted if p.effect == "sensor_bias"):
        obs[:, p.index] += p.values["bias"]
    return obs


def _state(data: Any, system: System) -> np.ndarray:
    return np.concatenate([data.qpos[: system.dof], data.qvel[: system.dof]])
