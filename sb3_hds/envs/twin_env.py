"""Any twin as a Gymnasium environment."""

import contextlib
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium import spaces

from sb3_hds.core import Actuator, Channel, State, Twin
from sb3_hds.core.contract import check_methods
from sb3_hds.envs import programs
from sb3_hds.envs.validation import check_action, check_start, start_state
from sb3_hds.twins import registry

_RENDER_MODES = ["rgb_array"]


class TwinEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """
    A twin as an environment: its ``initial``, ``step``, ``observe``, ``reward``, ``terminated``.

    Has no time limit of its own; ``gymnasium.make`` of a registered id adds one. Steps are computed
    on the CPU, where a single copy steps fastest. They are deterministic: all randomness is in
    ``reset``.

    :param twin: a twin, or the name or environment id under which one is registered
    :param render_mode: ``"rgb_array"`` or None
    :param settings: values of the twin's parameters by name, in their units; where ``twin`` is a
        name, also its options, ``dt`` [s] and ``substeps``
    :raises NoTwinError: for a name that is not registered
    :raises ParameterError: for a setting that the twin does not have, or a value out of bounds
    :raises TwinError: for a twin whose methods return the wrong type, shape or dtype
    :raises ValueError: for another render mode
    """

    metadata: dict[str, Any] = {"render_modes": _RENDER_MODES}
    observation_space: spaces.Box
    action_space: spaces.Box

    def __init__(
        self, twin: Twin | str = "Pendulum", render_mode: str | None = None, **settings: Any
    ) -> None:
        self.twin = twin_from(twin, settings)
        self.render_mode = check_render_mode(render_mode)
        self.metadata = metadata_of(self.twin)
        self.observation_space = box_of(self.twin.channels)
        self.action_space = box_of(self.twin.actuators)
        self._state: State | None = None
        self._canvas: Any = None

    @property
    def state(self) -> State:
        """
        The current state, memory included.

        :raises gymnasium.error.ResetNeeded: before the first reset
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded(
                f"The state of {self.twin.name} is not set yet. Call reset() first."
            )
        return self._state

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """
        Begin an episode.

        :param seed: restarts the sequence of start states; None continues it
        :param options: ``{"state": (q, v)}`` sets the start state, in the units of the joints
        :return: observation of shape ``(n_obs,)``, empty info
        :raises ValueError: for an unknown option, or a state of the wrong size, not finite, or
            outside the observation space
        """
        super().reset(seed=seed)
        run, params = programs.for_one(self.twin), self.twin.params
        with _on_cpu():
            drawn = run.draw(draw_seed(self.np_random), params)
            state = jax.device_get(start_state(self.twin, drawn, options))
            obs = np.array(run.observe(state, params), np.float32)
        check_start(self.twin, self.observation_space, obs, options)
        self._state = state
        return obs, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        Act for one control interval.

        :param action: in the units of the action space, shape ``(n_act,)``; the twin clips it
        :return: observation, reward, terminated, truncated (always False), empty info
        :raises ValueError: for an action of the wrong shape or not finite
        """
        action = check_action(self.twin, action, self.action_space.shape)
        with _on_cpu():
            after = programs.for_one(self.twin).step(self.state, action, self.twin.params)
            self._state, obs, reward, terminated = jax.device_get(after)
        return np.array(obs, np.float32), float(reward), bool(terminated), False, {}

    def render(self) -> np.ndarray | None:
        """:return: an RGB image, uint8, shape ``(400, 400, 3)``; None without a render mode"""
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() shows nothing without a render mode: make the environment with "
                'render_mode="rgb_array".'
            )
            return None
        from sb3_hds.envs.rendering import Canvas, view_of

        with _on_cpu():
            if self._canvas is None:
                self._canvas = Canvas(view_of(self.twin))
            points = programs.for_one(self.twin).sketch(self.state, self.twin.params)
            return self._canvas.draw(points)

    def close(self) -> None:
        self._canvas = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_canvas": None}


def twin_from(twin: Twin | str, settings: Mapping[str, Any]) -> Twin:
    """
    :return: the twin with ``settings``
    :raises TypeError: for anything but a twin or a name
    :raises TwinError: for a twin whose methods return the wrong type, shape or dtype
    """
    if isinstance(twin, Twin):
        check_methods(twin)
        return twin.with_parameters(**settings) if settings else twin
    if isinstance(twin, str):
        return registry.make(twin, **settings)
    raise TypeError(
        f"An environment is made of a twin or the name of one, got {twin!r}. "
        f"Names: {', '.join(registry.names())}."
    )


def check_render_mode(mode: str | None) -> str | None:
    """:raises ValueError: for a render mode that twins do not support"""
    if mode is not None and mode not in _RENDER_MODES:
        raise ValueError(
            f"Twins render with render_mode='rgb_array' or None, got {mode!r}. "
            "gymnasium.make shows them in a window for render_mode='human'."
        )
    return mode


def metadata_of(twin: Twin) -> dict[str, Any]:
    """:return: the metadata that Gymnasium and SB3's video recorders read"""
    return {"render_modes": list(_RENDER_MODES), "render_fps": max(1, round(1.0 / twin.dt))}


def box_of(signals: Sequence[Actuator | Channel]) -> spaces.Box:
    """:return: the space of a twin's observations or actions, with the bounds of its signals"""
    low, high = np.array([(signal.low, signal.high) for signal in signals], np.float32).T
    return spaces.Box(low, high)


def draw_seed(generator: np.random.Generator) -> np.uint32:
    """:return: the seed of the next episode's start state"""
    return generator.integers(2**32, dtype=np.uint32)


def _on_cpu() -> contextlib.AbstractContextManager[None]:
    """Compute on the CPU, even if JAX has an accelerator."""
    return jax.default_device(_cpu_device())


@functools.cache
def _cpu_device() -> Any:
    """:return: None if JAX was configured without a CPU, which selects the default device"""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return None
