"""A stand-in for a real pendulum: the task of ``Pendulum-v1``, simulated by MuJoCo."""

import math
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from sb3_hds.envs.tasks.engine import check_quantity, engine

_MODEL = """
<mujoco>
  <option timestep="{timestep}" integrator="RK4" gravity="0 0 {gravity}"/>
  <worldbody>
    <body>
      <joint name="hinge" type="hinge" axis="0 1 0" damping="{damping}" frictionloss="{friction}"/>
      <inertial pos="0 0 {centre}" mass="{mass}" diaginertia="{inertia} {inertia} {about_rod}"/>
    </body>
  </worldbody>
</mujoco>
"""
_MAX_TORQUE = 2.0  # [N m]
_ENGINE_STEP = 0.0025  # [s]
# Moment of inertia about the rod's own axis, relative to that about its centre.
_THIN_ROD = 1e-3
# Time and torque of the command before the first one.
_NO_COMMAND = (-math.inf, 0.0)
_LONGEST_DELAY = 0.2  # [s]


class PendulumReal(gymnasium.Env[np.ndarray, np.ndarray]):
    """
    The pendulum of ``Pendulum-v1`` in continuous time, with friction, drag, a non-ideal drive and
    noisy sensors. It stands in for hardware: no twin takes part in its simulation.

    The reward is that of ``Pendulum-v1``, computed from the true state and the command. Start
    states are those of ``Pendulum-v1``, or set by ``reset(options={"state": (angle, speed)})``.

    :param mass: of the rod [kg]
    :param length: of the rod [m]
    :param gravity: [m/s2]
    :param damping: of the hinge [N m s/rad]
    :param friction: dry friction of the hinge [N m]
    :param drag: of the air [N m s2/rad2]
    :param gain: of the drive, as a factor
    :param delay: of commands [s], at most 0.2
    :param lag: time constant of the drive [s]
    :param noise: standard deviation of each observation, in its own unit
    :param payload: point mass at the tip [kg]
    :param dt: control interval [s]
    :param render_mode: ``"rgb_array"`` or None
    :raises ValueError: for a value that is not finite or not physical, or another render mode
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(
        self,
        mass: float = 1.0,
        length: float = 1.0,
        gravity: float = 10.0,
        damping: float = 0.0,
        friction: float = 0.0,
        drag: float = 0.0,
        gain: float = 1.0,
        delay: float = 0.0,
        lag: float = 0.0,
        noise: float = 0.0,
        payload: float = 0.0,
        dt: float = 0.05,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be 'rgb_array' or None, got {render_mode!r}.")
        self.render_mode = render_mode
        self.mass = check_quantity("mass", mass, positive=True)
        self.length = check_quantity("length", length, positive=True)
        self.gravity = check_quantity("gravity", gravity)
        self.damping = check_quantity("damping", damping)
        self.friction = check_quantity("friction", friction)
        self.drag = check_quantity("drag", drag)
        self.gain = check_quantity("gain", gain)
        self.delay = check_quantity("delay", delay, maximum=_LONGEST_DELAY)
        self.lag = check_quantity("lag", lag)
        self.noise = check_quantity("noise", noise)
        self.payload = check_quantity("payload", payload)
        self.dt = check_quantity("dt", dt, positive=True)
        self.frame_skip = max(1, round(self.dt / _ENGINE_STEP))
        self.model = self._build_model()
        self.data = engine.MjData(self.model)
        self.action_space = spaces.Box(-_MAX_TORQUE, _MAX_TORQUE, (1,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self._commands: list[tuple[float, float]] = [_NO_COMMAND]
        self._drive = 0.0
        self._canvas: Any = None

    def set_payload(self, payload: float) -> None:
        """Change the point mass at the tip between two steps. The state does not change."""
        self.payload = check_quantity("payload", payload)
        before, self.model = self.data, self._build_model()
        self.data = engine.MjData(self.model)
        self.data.time, self.data.qpos[:], self.data.qvel[:] = before.time, before.qpos, before.qvel

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """
        :param seed: restarts the sequence of start states and of the noise
        :param options: ``{"state": (angle, speed)}`` sets the start state [rad, rad/s]
        :raises ValueError: for another option, or a state that is not two finite numbers
        """
        super().reset(seed=seed)
        engine.mj_resetData(self.model, self.data)
        start = self.np_random.uniform([-np.pi, -1.0], [np.pi, 1.0])
        if options:
            start = _start_state(options)
        self.data.qpos[0], self.data.qvel[0] = start
        self._commands, self._drive = [_NO_COMMAND], 0.0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        :param action: torque [N m], shape ``(1,)``, clipped to 2 N m
        :return: observation (cos, sin, speed), reward, False, False, empty info
        :raises ValueError: for an action of another shape or not finite
        """
        action = np.asarray(action, np.float64)
        if action.shape != (1,) or not np.isfinite(action).all():
            raise ValueError(f"PendulumReal takes one finite torque, shape (1,), got {action!r}.")
        torque = float(np.clip(action[0], -_MAX_TORQUE, _MAX_TORQUE))
        angle, speed = float(self.data.qpos[0]), float(self.data.qvel[0])
        wrapped = (angle + math.pi) % (2.0 * math.pi) - math.pi
        reward = -(wrapped**2 + 0.1 * speed**2 + 0.001 * torque**2)
        self._commands.append((self.data.time, torque))
        for _ in range(self.frame_skip):
            drag = self.drag * self.data.qvel[0] * abs(self.data.qvel[0])
            self.data.qfrc_applied[0] = self.gain * self._drive_torque() - drag
            engine.mj_step(self.model, self.data)
        return self._observation(), reward, False, False, {}

    def render(self) -> np.ndarray | None:
        """:return: an RGB image, uint8, shape ``(400, 400, 3)``; None without a render mode"""
        if self.render_mode is None:
            return None
        from sb3_hds.envs.rendering import Canvas, View

        if self._canvas is None:
            self._canvas = Canvas(View(0.0, 0.0, 1.2 * self.length))
        angle = float(self.data.qpos[0])
        tip = self.length * np.array([math.sin(angle), math.cos(angle)])
        return self._canvas.draw(np.stack([np.zeros(2), tip]))

    def close(self) -> None:
        self._canvas = None

    def _build_model(self) -> Any:
        """The rod and the point mass at its tip, as one rigid body."""
        mass = self.mass + self.payload
        centre = (0.5 * self.mass + self.payload) * self.length / mass
        about_hinge = (self.mass / 3.0 + self.payload) * self.length**2
        inertia = about_hinge - mass * centre**2
        text = _MODEL.format(
            timestep=self.dt / self.frame_skip,
            gravity=-self.gravity,
            damping=self.damping,
            friction=self.friction,
            centre=centre,
            mass=mass,
            inertia=inertia,
            about_rod=_THIN_ROD * inertia,
        )
        return engine.MjModel.from_xml_string(text)

    def _drive_torque(self) -> float:
        """Torque of the drive in the next engine step [N m]."""
        h = self.model.opt.timestep
        issued_at = self.data.time + 0.5 * h - self.delay
        command = next(torque for since, torque in reversed(self._commands) if since <= issued_at)
        if self.lag <= 0.0:
            return command
        before = self._drive
        self._drive = command + (before - command) * math.exp(-h / self.lag)
        return 0.5 * (before + self._drive)

    def _observation(self) -> np.ndarray:
        angle, speed = float(self.data.qpos[0]), float(self.data.qvel[0])
        obs = np.array([math.cos(angle), math.sin(angle), speed])
        if self.noise:
            obs += self.noise * self.np_random.standard_normal(3)
        return obs.astype(np.float32)


def _start_state(options: Mapping[str, Any]) -> np.ndarray:
    try:
        (name, value), *others = options.items()
        start = np.array([np.ravel(part).astype(float) for part in value]).ravel()
        if name != "state" or others or start.shape != (2,) or not np.isfinite(start).all():
            raise ValueError
    except (TypeError, ValueError):
        raise ValueError(
            "The only option of reset() is {'state': (angle, speed)} in rad and rad/s, "
            f"got {dict(options)!r}."
        ) from None
    return start
