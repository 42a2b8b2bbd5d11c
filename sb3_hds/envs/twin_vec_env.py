"""Many copies of a twin as one vectorised environment of Stable-Baselines3."""

import warnings
from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvStepReturn

from sb3_hds.core import State, Twin
from sb3_hds.envs import programs
from sb3_hds.envs.twin_env import box_of, check_render_mode, draw_seed, metadata_of, twin_from
from sb3_hds.envs.validation import check_action, check_start, start_state

_NO_LIMIT = np.iinfo(np.int32).max


class TwinVecEnv(VecEnv):
    """
    Copies of a twin that step together in one compiled call.

    Equivalent to a ``DummyVecEnv`` of ``TwinEnv`` with a ``TimeLimit``: the same seeds give the
    same start states, and steps differ only by rounding. A copy whose episode ends is reset in the
    same call; its last observation is ``infos[i]["terminal_observation"]``.

    The copies share their parameters and are not separate environments: attributes are read and
    written for all of them at once.

    :param twin: a twin, or the name or environment id under which one is registered
    :param n_envs: number of copies
    :param max_episode_steps: steps after which an episode is truncated; None: the twin's own limit;
        -1: no limit
    :param render_mode: ``"rgb_array"`` or None
    :param settings: values of the twin's parameters by name, in their units; where ``twin`` is a
        name, also its options, ``dt`` [s] and ``substeps``
    :raises NoTwinError: for a name that is not registered
    :raises ParameterError: for a setting that the twin does not have, or a value out of bounds
    :raises TwinError: for a twin whose methods return the wrong type, shape or dtype
    :raises ValueError: for no copies, an impossible limit, or another render mode
    """

    observation_space: spaces.Box
    action_space: spaces.Box

    def __init__(
        self,
        twin: Twin | str = "Pendulum",
        n_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        self.twin = twin_from(twin, settings)
        self.spec = gymnasium.registry.get(self.twin.env_id) if self.twin.env_id else None
        self.max_episode_steps = _step_limit(self.twin, max_episode_steps)
        if n_envs < 1:
            raise ValueError(
                f"A vectorised environment needs at least one copy, got n_envs={n_envs}."
            )
        self.render_mode = check_render_mode(render_mode)
        super().__init__(n_envs, box_of(self.twin.channels), box_of(self.twin.actuators))
        self.metadata = metadata_of(self.twin)
        self._generators = [seeding.np_random(None)[0] for _ in range(n_envs)]
        self._next_seeds = np.zeros(n_envs, np.uint32)
        self._draw_seeds(range(n_envs))
        self._elapsed = np.zeros(n_envs, np.int32)
        self._states: State | None = None
        self._actions: np.ndarray | None = None
        self._canvas: Any = None

    @property
    def states(self) -> State:
        """
        The current states, memory included, with a leading axis ``n_envs``.

        :raises gymnasium.error.ResetNeeded: before the first reset
        """
        if self._states is None:
            raise gymnasium.error.ResetNeeded(
                f"The copies of {self.twin.name} have no state yet. Call reset() first."
            )
        return self._states

    def reset(self) -> np.ndarray:
        """
        Begin an episode in every copy.

        :return: observations, shape ``(n_envs, n_obs)``
        :raises ValueError: for options that ``TwinEnv.reset`` rejects
        """
        seeds, options = self._seeds, self._options
        self._reset_seeds()
        self._reset_options()
        for i, seed in enumerate(seeds):
            if seed is not None:
                self._generators[i], _ = seeding.np_random(seed)
                self._draw_seeds([i])
        run, params = programs.for_many(self.twin), self.twin.params
        drawn = jax.device_get(run.draw(self._next_seeds, params))
        states = _start_states(self.twin, drawn, options)
        obs = np.array(run.observe(states, params), np.float32)
        for row, wanted in zip(obs, options, strict=True):
            check_start(self.twin, self.observation_space, row, wanted)
        self._states = states
        self._elapsed = np.zeros(self.num_envs, np.int32)
        self._draw_seeds(range(self.num_envs))
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """
        :param actions: in the units of the action space, shape ``(n_envs, n_act)``
        :raises ValueError: for another shape, or numbers that are not finite
        """
        self._actions = check_action(self.twin, actions, (self.num_envs, *self.action_space.shape))

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: observations ``(n_envs, n_obs)``, rewards and dones ``(n_envs,)``, infos with SB3's
            keys ``TimeLimit.truncated`` and, where an episode ended, ``terminal_observation``
        """
        after = jax.device_get(
            programs.for_many(self.twin).step(
                self.states,
                self._elapsed,
                self._actions,
                self._next_seeds,
                self.max_episode_steps,
                self.twin.params,
            )
        )
        self._states, self._elapsed = after.state, after.elapsed
        only_truncated = after.truncated & ~after.ended.terminated
        dones = after.truncated | after.ended.terminated
        infos: list[dict[str, Any]]
        infos = [{"TimeLimit.truncated": truncated} for truncated in only_truncated.tolist()]
        ended = np.flatnonzero(dones).tolist()
        for i in ended:
            infos[i]["terminal_observation"] = np.array(after.ended.obs[i], np.float32)
            self.reset_infos[i] = {}
        self._draw_seeds(ended)
        obs = np.array(after.obs, np.float32)
        return obs, np.array(after.ended.reward, np.float32), dones, infos

    def close(self) -> None:
        self._canvas = None

    def get_images(self) -> Sequence[np.ndarray | None]:
        """:return: an RGB image of each copy, as from ``TwinEnv.render``; None without a mode"""
        if self.render_mode is None:
            warnings.warn('There are no images without render_mode="rgb_array".')
            return [None] * self.num_envs
        from sb3_hds.envs.rendering import Canvas, view_of

        if self._canvas is None:
            self._canvas = Canvas(view_of(self.twin))
        sketches = programs.for_many(self.twin).sketch(self.states, self.twin.params)
        return [self._canvas.draw(points) for points in np.asarray(sketches)]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """:return: the shared attribute, once for each requested copy"""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """:raises ValueError: for only some of the copies: they share their attributes"""
        if set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise ValueError(
                f"The copies of a TwinVecEnv share '{attr_name}'. Set it for all (indices=None), "
                "or use DummyVecEnv of several TwinEnv."
            )
        setattr(self, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """:raises AttributeError: always: the copies are not separate environments"""
        raise AttributeError(
            f"The copies of a TwinVecEnv are not separate environments, so '{method_name}' cannot "
            "be called on them. Use DummyVecEnv of several TwinEnv."
        )

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None
    ) -> list[bool]:
        """:return: False for each requested copy: they cannot be wrapped one by one"""
        return [False for _ in self._get_indices(indices)]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_canvas": None}

    def _draw_seeds(self, indices: Sequence[int]) -> None:
        """Draw the seeds of the next episodes, as ``TwinEnv.reset`` would."""
        for i in indices:
            self._next_seeds[i] = draw_seed(self._generators[i])


def _start_states(twin: Twin, drawn: State, options: Sequence[dict[str, Any]]) -> State:
    """The drawn start states, or those that the options of a copy set."""
    q, v = np.array(drawn.q), np.array(drawn.v)
    for i, wanted in enumerate(options):
        one = start_state(twin, State(q[i], v[i], {}), wanted)
        q[i], v[i] = one.q, one.v
    return drawn._replace(q=q, v=v)


def _step_limit(twin: Twin, max_episode_steps: int | None) -> int:
    limit = twin.max_episode_steps if max_episode_steps is None else max_episode_steps
    if limit is None or limit == -1:
        return _NO_LIMIT
    if limit < 1:
        raise ValueError(
            f"max_episode_steps must be positive, -1 for no limit, or None for {twin.name}'s own "
            f"({twin.max_episode_steps}); got {max_episode_steps}."
        )
    return limit
