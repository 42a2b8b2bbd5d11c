"""Gymnasium's inverted pendulum with friction that its XML does not have."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from gymnasium.utils import EzPickle

from sb3_hds.envs.tasks.engine import check_quantity, engine

_SLIDER, _HINGE = 0, 1


class InvertedPendulumFriction(InvertedPendulumEnv):
    """
    ``InvertedPendulum-v5`` with additional joint friction. It stands in for hardware: no twin takes
    part in its simulation.

    :param slider_damping: viscous friction of the rail, in addition to the XML's [N s/m]
    :param hinge_damping: viscous friction of the hinge, in addition to the XML's [N m s/rad]
    :param slider_friction: dry friction of the rail [N]
    :param hinge_friction: dry friction of the hinge [N m]
    :param swing_up: the pole starts hanging and turns freely, episodes do not terminate,
        observations are (position, cos, sin, speed, rate), and the reward is largest upright in the
        middle: see the twin of the same name
    :param rail_ends: whether stops limit the cart to 1 m
    :param noise: standard deviation of each observation, in its own unit
    :param reset_noise_scale: as in ``InvertedPendulum-v5``
    :param settings: further arguments of ``InvertedPendulum-v5``
    :raises ValueError: for friction or noise that is negative or not finite
    """

    def __init__(
        self,
        slider_damping: float = 0.0,
        hinge_damping: float = 0.0,
        slider_friction: float = 0.0,
        hinge_friction: float = 0.0,
        swing_up: bool = False,
        rail_ends: bool = True,
        noise: float = 0.0,
        reset_noise_scale: float = 0.01,
        **settings: Any,
    ) -> None:
        self.slider_damping = check_quantity("slider_damping", slider_damping)
        self.hinge_damping = check_quantity("hinge_damping", hinge_damping)
        self.slider_friction = check_quantity("slider_friction", slider_friction)
        self.hinge_friction = check_quantity("hinge_friction", hinge_friction)
        self.noise = check_quantity("noise", noise)
        self.swing_up, self.rail_ends = bool(swing_up), bool(rail_ends)
        super().__init__(reset_noise_scale=reset_noise_scale, **settings)
        EzPickle.__init__(
            self,
            slider_damping,
            hinge_damping,
            slider_friction,
            hinge_friction,
            swing_up,
            rail_ends,
            noise,
            reset_noise_scale,
            **settings,
        )
        if self.swing_up:
            self.observation_space = spaces.Box(-np.inf, np.inf, (5,), np.float64)

    @property
    def nominal(self) -> Any:
        """The model of the XML without the additional friction, as twins read it."""
        return SimpleNamespace(
            unwrapped=SimpleNamespace(
                model=self._shipped,
                dt=self.dt,
                frame_skip=self.frame_skip,
                _reset_noise_scale=self._reset_noise_scale,
            )
        )

    def _initialize_simulation(self) -> tuple[Any, Any]:
        self._shipped = engine.MjModel.from_xml_path(self.fullpath)
        model, data = super()._initialize_simulation()
        model.dof_damping[_SLIDER] += self.slider_damping
        model.dof_damping[_HINGE] += self.hinge_damping
        model.dof_frictionloss[_SLIDER] += self.slider_friction
        model.dof_frictionloss[_HINGE] += self.hinge_friction
        if self.swing_up:
            model.jnt_limited[_HINGE] = 0
        if not self.rail_ends:
            model.jnt_limited[_SLIDER] = 0
        return model, data

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        :param action: command of the motor, shape ``(1,)``
        :return: observation, reward, terminated, False, info
        """
        if not self.swing_up:
            obs, _, _, truncated, info = super().step(action)
            # By the true angle: noise does not make the pole fall.
            fallen = bool(abs(self.data.qpos[_HINGE]) > 0.2) or not np.isfinite(obs).all()
            return obs, float(not fallen), fallen, truncated, info | {"reward_survive": not fallen}
        self.do_simulation(action, self.frame_skip)
        (x, angle), (speed, rate) = self.data.qpos, self.data.qvel
        costs = 0.1 * x**2 + 0.005 * speed**2 + 0.0005 * rate**2 + 0.001 * float(action[0]) ** 2
        reward = 0.5 * (1.0 + np.cos(angle)) - costs
        obs = self._get_obs()
        if self.render_mode == "human":
            self.render()
        return obs, float(reward), not bool(np.isfinite(obs).all()), False, {}

    def reset_model(self) -> np.ndarray:
        super().reset_model()
        if self.swing_up:
            qpos = self.data.qpos.copy()
            qpos[_HINGE] += np.pi
            self.set_state(qpos, self.data.qvel.copy())
        return self._get_obs()

    def _get_obs(self) -> np.ndarray:
        (x, angle), velocity = self.data.qpos, self.data.qvel
        where = [x, np.cos(angle), np.sin(angle)] if self.swing_up else [x, angle]
        obs = np.concatenate([where, velocity])
        return obs + self.noise * self.np_random.standard_normal(obs.size) if self.noise else obs
