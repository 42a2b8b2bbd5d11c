"""A small quadruped with series-elastic joints; efficient gaits store energy in the springs."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from sb3_hds.envs.tasks.engine import check_quantity, engine

#: legs in the order of the actuators: front left, front right, hind left, hind right
LEGS = ("FL", "FR", "HL", "HR")
CONTROLS = ("torque", "position", "force")

_ENGINE_STEP = 0.002  # [s]
_DT = 0.02  # [s]
_HIP = (0.13, 0.08)  # forwards and sideways from the middle of the trunk [m]
_THIGH = _SHANK = 0.08  # [m]
_FOOT = 0.015  # [m]
_REST_POSE = (0.6, -1.2)  # hip and knee relative to the vertical if all joints are zero [rad]
_MAX_TORQUE = 2.5  # of a motor [N m]
_MAX_ANGLE = 0.6  # of a motor's target [rad]
_MAX_FORCE = 2.0  # commanded torque of a spring [N m]
# Gains of the position loop of a motor [N m/rad], [N m s/rad].
_DRIVE_KP, _DRIVE_KD = 15.0, 0.35
# A fall: the vertical component of the trunk's axis, or the trunk's height [m], is below this.
_MIN_UPRIGHT, _MIN_HEIGHT = 0.5, 0.05

_LEG = """
<body name="{leg}_thigh" pos="{x} {y} 0" euler="0 {hip} 0">
  <joint name="{leg}_hip" range="-1.4 1.4"/>
  <geom type="capsule" fromto="0 0 0 0 0 -{thigh}" size="0.012" mass="0.10"/>
  <body name="{leg}_shank" pos="0 0 -{thigh}" euler="0 {knee} 0">
    <joint name="{leg}_knee" range="-1.2 1.2"/>
    <geom type="capsule" fromto="0 0 0 0 0 -{shank}" size="0.009" mass="0.04"/>
    <geom name="{leg}_foot" type="sphere" pos="0 0 -{shank}" size="{foot}" mass="0.02"
          contype="1" friction="1.0 0.01 0.001"/>
  </body>
  <body name="{leg}_knee_rotor">
    <joint name="{leg}_knee_motor" armature="{armature}" damping="0.02"/>
    <inertial pos="0 0 0" mass="0.06" diaginertia="1e-5 1e-5 1e-5"/>
  </body>
</body>
<body name="{leg}_hip_rotor" pos="{x} {y} 0">
  <joint name="{leg}_hip_motor" armature="{armature}" damping="0.02"/>
  <inertial pos="0 0 0" mass="0.06" diaginertia="1e-5 1e-5 1e-5"/>
</body>
"""
_MODEL = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{step}" integrator="implicitfast"/>
  <default>
    <joint axis="0 1 0"/>
    <geom contype="0" conaffinity="0" rgba="0.15 0.29 0.43 1"/>
  </default>
  <worldbody>
    <light pos="0 0 3" diffuse="0.8 0.8 0.8"/>
    <geom name="floor" type="plane" size="40 40 1" conaffinity="1" friction="1.0 0.01 0.001"
          rgba="0.96 0.95 0.92 1"/>
    <body name="trunk" pos="0 0 0.2">
      <freejoint name="trunk"/>
      <geom name="trunk" type="box" size="0.16 0.06 0.03" mass="1.6" contype="1"
            rgba="0.82 0.29 0.36 1"/>
      {legs}
    </body>
  </worldbody>
  <tendon>{springs}</tendon>
  <actuator>{motors}</actuator>
</mujoco>
"""
_SPRING = """
<fixed name="{name}_spring" stiffness="{k}" damping="{d}" springlength="0">
  <joint joint="{name}_motor" coef="1"/><joint joint="{name}" coef="-1"/>
</fixed>"""
_MOTOR = (
    '<motor name="{name}" joint="{name}_motor" gear="{gear}" ctrllimited="true" ctrlrange="-1 1"/>'
)


class ElasticQuadruped(gymnasium.Env[np.ndarray, np.ndarray]):
    """
    Walk forwards on four legs with a hip and a knee each. Every motor drives its joint through a
    spring, as in the DLR's *bert*, which has about the same size and weight. Simulated by MuJoCo's
    engine; it has no twin.

    The action has one element in [-1, 1] for each motor, hip and knee of the legs front left, front
    right, hind left, hind right:

    - ``control="torque"``: motor torque, at most 2.5 N m
    - ``"position"``: motor angle, at most 0.6 rad from the standing pose; the drive tracks it
    - ``"force"``: torque of the spring, at most 2 N m; the drive moves the motor until the spring
      is deflected accordingly

    The observation consists of gravity, linear and angular velocity in the frame of the trunk (3
    each), angles and speeds of the joints, torques of the springs and speeds of the motors (8
    each). All angles are zero in the standing pose. The reward is the forward speed [m/s] minus 0.2
    times the lateral speed, 0.1 times the yaw rate [rad/s] and 0.005 times the power of the motors
    [W]. An episode terminates with a fall.

    Source: the robot, Seidel et al., *Using elastically actuated legged robots in rough terrain*,
    ICRA 2020; the task, Raffin et al., *Learning to exploit elastic actuators for quadruped
    locomotion*, 2022.

    :param control: ``"torque"``, ``"position"`` or ``"force"``: the meaning of an action
    :param stiffness: of the springs [N m/rad]
    :param damping: of the springs [N m s/rad]
    :param noise: standard deviation of each observation, in its own unit
    :param render_mode: ``"rgb_array"`` or None
    :raises ValueError: for another ``control`` or render mode, or a quantity that is not physical
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1.0 / _DT)}

    def __init__(
        self,
        control: str = "position",
        stiffness: float = 5.0,
        damping: float = 0.02,
        noise: float = 0.0,
        render_mode: str | None = None,
    ) -> None:
        if control not in CONTROLS:
            raise ValueError(f"control must be one of {CONTROLS}, got {control!r}.")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be 'rgb_array' or None, got {render_mode!r}.")
        self.control, self.render_mode = control, render_mode
        self.commands_positions = control == "position"
        self.stiffness = check_quantity("stiffness", stiffness, positive=True)
        self.damping = check_quantity("damping", damping)
        self.noise = check_quantity("noise", noise)
        self.dt, self.frame_skip = _DT, round(_DT / _ENGINE_STEP)
        self.model = engine.MjModel.from_xml_string(_mjcf(self.stiffness, self.damping))
        self.data = engine.MjData(self.model)
        names = [f"{leg}_{part}" for leg in LEGS for part in ("hip", "knee")]
        joints = [self.model.joint(name) for name in names]
        motors = [self.model.joint(f"{name}_motor") for name in names]
        self._q = np.array([j.qposadr[0] for j in joints])
        self._v = np.array([j.dofadr[0] for j in joints])
        self._motor_q = np.array([m.qposadr[0] for m in motors])
        self._motor_v = np.array([m.dofadr[0] for m in motors])
        self.action_space = spaces.Box(-1.0, 1.0, (len(names),), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (9 + 4 * len(names),), np.float32)
        self._renderer: Any = None

    def state_vector(self) -> np.ndarray:
        """:return: ``qpos`` and ``qvel``, concatenated as in Gymnasium's MuJoCo environments"""
        return np.concatenate([self.data.qpos, self.data.qvel])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """
        Start in the standing pose, with each joint and its motor up to 0.05 rad off.

        :param seed: restarts the sequence of start states and of the noise
        """
        super().reset(seed=seed)
        engine.mj_resetData(self.model, self.data)
        joints = self.np_random.uniform(-0.05, 0.05, len(self._q))
        self.data.qpos[self._q] = self.data.qpos[self._motor_q] = joints
        self.data.qpos[2] = _height(joints)
        engine.mj_forward(self.model, self.data)
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        :param action: shape ``(8,)``, clipped to -1 and 1
        :return: observation, reward, whether it fell, False, and ``info`` with ``x_velocity``
            [m/s] and ``power`` [W]
        :raises ValueError: for an action of another shape or not finite
        """
        action = np.asarray(action, np.float64)
        if action.shape != self.action_space.shape or not np.isfinite(action).all():
            raise ValueError(f"ElasticQuadruped takes 8 finite numbers, got {action!r}.")
        action, power = np.clip(action, -1.0, 1.0), 0.0
        before = self.data.qpos[:2].copy()
        for _ in range(self.frame_skip):
            torque = np.clip(self._drive_torque(action), -_MAX_TORQUE, _MAX_TORQUE)
            self.data.ctrl[:] = torque / _MAX_TORQUE
            power += float(np.abs(torque * self.data.qvel[self._motor_v]).sum()) / self.frame_skip
            engine.mj_step(self.model, self.data)
        forwards, sideways = (self.data.qpos[:2] - before) / self.dt
        turning = abs(float(self.data.qvel[5]))
        reward = forwards - 0.2 * abs(sideways) - 0.1 * turning - 0.005 * power
        info = {"x_velocity": float(forwards), "power": power}
        return self._observation(), float(reward), self._fallen(), False, info

    def render(self) -> np.ndarray | None:
        """:return: an RGB image, uint8, shape ``(240, 320, 3)``; None without a render mode"""
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = engine.Renderer(self.model, 240, 320)
        camera = engine.MjvCamera()
        camera.lookat[:] = self.data.qpos[0], self.data.qpos[1], 0.1
        camera.distance, camera.azimuth, camera.elevation = 0.9, 120.0, -15.0
        self._renderer.update_scene(self.data, camera)
        return self._renderer.render()

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _drive_torque(self, action: np.ndarray) -> np.ndarray:
        """Torques of the drives in the next engine step [N m]."""
        if self.control == "torque":
            return _MAX_TORQUE * action
        motor, speed = self.data.qpos[self._motor_q], self.data.qvel[self._motor_v]
        if self.control == "position":
            return _DRIVE_KP * (_MAX_ANGLE * action - motor) - _DRIVE_KD * speed
        # The motor follows the joint and holds the deflection that gives the commanded torque.
        force = _MAX_FORCE * action
        away = self.data.qpos[self._q] + force / self.stiffness - motor
        return force + _DRIVE_KP * away + _DRIVE_KD * (self.data.qvel[self._v] - speed)

    def _fallen(self) -> bool:
        state = self.state_vector()
        up = self.data.xmat[1].reshape(3, 3)[2, 2]
        low = self.data.qpos[2] < _MIN_HEIGHT
        return bool(up < _MIN_UPRIGHT or low or not np.isfinite(state).all())

    def _observation(self) -> np.ndarray:
        frame = self.data.xmat[1].reshape(3, 3)
        q, motor = self.data.qpos[self._q], self.data.qpos[self._motor_q]
        obs = np.concatenate(
            [
                -frame[2],
                frame.T @ self.data.qvel[:3],
                self.data.qvel[3:6],
                q,
                self.data.qvel[self._v],
                self.stiffness * (motor - q),
                self.data.qvel[self._motor_v],
            ]
        )
        if self.noise:
            obs += self.noise * self.np_random.standard_normal(obs.size)
        return obs.astype(np.float32)


def _height(joints: np.ndarray) -> float:
    """Height of the trunk at which the lowest foot touches the floor [m]."""
    hip, knee = _REST_POSE[0] + joints[0::2], _REST_POSE[1] + joints[1::2]
    lengths = _THIGH * np.cos(hip) + _SHANK * np.cos(hip + knee)
    return float(lengths.max()) + _FOOT


def _mjcf(stiffness: float, damping: float) -> str:
    """The model as MJCF."""
    legs, names = [], []
    for leg in LEGS:
        x, y = _HIP[0] * (1 if leg[0] == "F" else -1), _HIP[1] * (1 if leg[1] == "L" else -1)
        bent = dict(zip(("hip", "knee"), _REST_POSE, strict=True))
        sizes = {"thigh": _THIGH, "shank": _SHANK, "foot": _FOOT, "armature": 0.002}
        legs.append(_LEG.format(leg=leg, x=x, y=y, **bent, **sizes))
        names += [f"{leg}_hip", f"{leg}_knee"]
    return _MODEL.format(
        step=_ENGINE_STEP,
        legs="".join(legs),
        springs="".join(_SPRING.format(name=n, k=stiffness, d=damping) for n in names),
        motors="".join(_MOTOR.format(name=n, gear=_MAX_TORQUE) for n in names),
    )
