"""Gymnasium's vectorised environments for the algorithms of Stable-Baselines3 and SBX."""

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvStepReturn

from sb3_hds.errors import ParameterError

PartialReset = Callable[[np.ndarray], tuple[Any, Any]]

# Keys of the last observation of an ended episode: Gymnasium's, and that of Gymnasium before 1.1
# and of some simulators.
_FINAL_OBS = ("final_obs", "final_observation")


class GymnasiumVecEnv(VecEnv):
    """
    A Gymnasium ``VectorEnv`` as a ``VecEnv`` of SB3.

    SB3 stores one transition per copy and step, and expects the last observation of an ended
    episode in ``infos[i]["terminal_observation"]`` and time-outs in
    ``infos[i]["TimeLimit.truncated"]``. What Gymnasium returns depends on its autoreset mode:

    - ``SAME_STEP``: the last observation is ``infos["final_obs"]``.
    - ``NEXT_STEP``: the step after an end ignores the action and returns a first observation. This
      is not a transition and must not be stored. Here, copies that ended are reset at once, so that
      there is no such step.
    - ``DISABLED``: ended copies are reset at once, too.

    The last two need an environment that can reset some of its copies only: Gymnasium's own do, by
    ``reset(options={"reset_mask": ...})``. It is checked that the other copies do not change.

    ``infos[i]["episode"]`` is return, length and time of an ended episode, as from SB3's
    ``Monitor``, unless the environment returns its own, of the same length. As in Gymnasium, asking
    the copies of an ``AsyncVectorEnv`` for an attribute that they lack ends their processes.

    :param env: as from ``gymnasium.make_vec``
    :param autoreset_mode: ``"NextStep"``, ``"SameStep"`` or ``"Disabled"``; None: that
        of the environment's ``metadata``
    :param partial_reset: takes a mask of copies, shape ``(n_envs,)``, and returns what
        ``env.reset`` does, for environments without ``reset_mask``; for a single copy, ``lambda
        mask: env.reset()``
    :raises ParameterError: for an unknown mode, or an environment whose step after an end cannot be
        avoided
    """

    def __init__(
        self,
        env: VectorEnv,
        *,
        autoreset_mode: str | AutoresetMode | None = None,
        partial_reset: PartialReset | None = None,
    ) -> None:
        if not isinstance(env, VectorEnv):
            raise ParameterError(
                f"GymnasiumVecEnv takes a gymnasium.vector.VectorEnv, got {type(env).__name__}. "
                "A single environment needs no adapter: SB3 vectorises it."
            )
        self.env = env
        self.autoreset_mode = _mode_of(env, autoreset_mode)
        self._partial_reset = partial_reset or self._reset_by_mask
        if partial_reset is None:
            _refuse_reset_steps(env, self.autoreset_mode)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self.spec = env.spec
        self._actions: Any = None
        self._returns, self._lengths = np.zeros(self.num_envs), np.zeros(self.num_envs, int)
        self._started = time.time()

    def reset(self) -> Any:
        """
        Start an episode in every copy.

        :raises ParameterError: for options that differ between copies
        """
        obs, infos = self.env.reset(seed=_seed_of(self._seeds), options=_options_of(self._options))
        self._reset_seeds()
        self._reset_options()
        self._returns[:], self._lengths[:] = 0.0, 0
        self.reset_infos = infos_of(infos, self.num_envs)
        return copied(obs)

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """:raises RuntimeError: if the environment violates its autoreset mode"""
        obs, rewards, terminated, truncated, raw_infos = self.env.step(self._actions)
        obs, rewards = copied(obs), np.asarray(rewards, np.float32)
        terminated, truncated = np.asarray(terminated, bool), np.asarray(truncated, bool)
        infos, dones = infos_of(raw_infos, self.num_envs), terminated | truncated
        if dones.any() and self.autoreset_mode is AutoresetMode.SAME_STEP:
            last = [self._split_final(infos, i) if dones[i] else None for i in range(len(dones))]
        else:
            last = [obs_of(obs, i) if dones[i] else None for i in range(len(dones))]
            obs = self._reset_ended(obs, dones) if dones.any() else obs
        self._returns += rewards
        self._lengths += 1
        for i, info in enumerate(infos):
            info["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
            if dones[i]:
                info["terminal_observation"] = last[i]
                info["episode"] = self._episode(i, info.get("episode"))
        self._returns[dones], self._lengths[dones] = 0.0, 0
        return obs, rewards, dones, infos

    def _split_final(self, infos: list[dict], i: int) -> Any:
        """The final observation of a copy that ended in ``SAME_STEP``; sorts its infos."""
        both = infos[i]
        name = next((name for name in _FINAL_OBS if name in both), None)
        if name is None:
            raise RuntimeError(
                f"{self.env} resets in the same step, but infos has no 'final_obs' for copy {i}, "
                "which ended: without its last observation, the value after a time-out cannot be "
                "bootstrapped. The environment has to return it."
            )
        last = both.pop(name)
        infos[i] = dict(both.pop("final_info", None) or {})
        self.reset_infos[i] = both
        return copied(last)

    def _reset_ended(self, before: Any, which: np.ndarray) -> Any:
        """
        :param before: observations of all copies
        :param which: mask of the copies to reset
        :return: observations of all copies after the reset
        """
        obs, raw_infos = self._partial_reset(which.copy())
        if not same_rows(before, obs, ~which):
            raise RuntimeError(
                f"{self.env} was asked to reset the copies {np.flatnonzero(which).tolist()}, and "
                'others changed as well: it has no reset(options={"reset_mask": ...}), or '
                "partial_reset ignores the mask. Use autoreset_mode=SAME_STEP, or pass "
                "partial_reset=."
            )
        infos = infos_of(raw_infos, self.num_envs)
        for i in np.flatnonzero(which):
            self.reset_infos[i] = infos[i]
        return copied(obs)

    def _reset_by_mask(self, which: np.ndarray) -> tuple[Any, Any]:
        try:
            return self.env.reset(options={"reset_mask": which})
        # Gymnasium's normalisation raises one or the other, depending on its version.
        except (ValueError, AssertionError) as error:
            raise RuntimeError(
                f"{self.env} could not reset some of its copies only ({error}). If a wrapper of "
                "Gymnasium normalises there, put SB3's VecNormalize above this adapter instead; "
                "otherwise use autoreset_mode=SAME_STEP, or pass partial_reset=."
            ) from error

    def _episode(self, i: int, statistics: Any) -> dict[str, float]:
        """
        :param statistics: of the environment; Gymnasium's vectorised ``RecordEpisodeStatistics``
            restarts its counts in all copies when one is reset
        """
        if isinstance(statistics, dict) and statistics.get("l") == self._lengths[i]:
            return statistics
        elapsed = round(time.time() - self._started, 6)
        return {"r": round(float(self._returns[i]), 6), "l": int(self._lengths[i]), "t": elapsed}

    def close(self) -> None:
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        if self.render_mode != "rgb_array":
            warnings.warn('There are no images without render_mode="rgb_array".')
            return [None] * self.num_envs
        return list(self.env.render() or [])  # type: ignore[arg-type]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        :return: one for each copy; that of the vectorised environment if copies are no environments
        """
        if attr_name == "render_mode" or not isinstance(self.env.unwrapped, _OF_ENVS):
            values = [getattr(self.env, attr_name)] * self.env.num_envs
        else:
            values = self.env.unwrapped.get_attr(attr_name)
        return [values[i] for i in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """:raises AttributeError: if the copies are no environments of their own"""
        which, copies = self._chosen(indices), self._copies(attr_name)
        everywhere = len(set(which)) == self.num_envs
        values = [value] * self.num_envs if everywhere else list(copies.get_attr(attr_name))
        for i in which:
            values[i] = value
        copies.set_attr(attr_name, values)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """
        :raises AttributeError: if the copies are no environments of their own
        :raises NotImplementedError: for some of the copies of an ``AsyncVectorEnv``
        """
        which, copies = self._chosen(indices), self._copies(method_name)
        if isinstance(copies, SyncVectorEnv):
            methods = [copies.envs[i].get_wrapper_attr(method_name) for i in which]
            return [method(*method_args, **method_kwargs) for method in methods]
        if set(which) != set(range(self.num_envs)):
            raise NotImplementedError(
                f"AsyncVectorEnv calls '{method_name}' in all copies or none: pass indices=None, "
                "or use SyncVectorEnv."
            )
        results = copies.call(method_name, *method_args, **method_kwargs)
        return [results[i] for i in which]

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None
    ) -> list[bool]:
        """:return: True for ``Monitor``, which this adapter replaces; False for other wrappers of
        copies in other processes, which cannot be inspected"""
        if wrapper_class is Monitor:
            return [True for _ in self._chosen(indices)]
        copies = self.env.unwrapped
        if not isinstance(copies, SyncVectorEnv):
            return [False for _ in self._chosen(indices)]
        return [is_wrapped(copies.envs[i], wrapper_class) for i in self._chosen(indices)]

    def _chosen(self, indices: VecEnvIndices) -> list[int]:
        return list(self._get_indices(indices))

    def _copies(self, name: str) -> SyncVectorEnv | AsyncVectorEnv:
        copies = self.env.unwrapped
        if isinstance(copies, _OF_ENVS):
            return copies
        raise AttributeError(
            f"The copies of {self.env} are no environments of their own, so '{name}' cannot be "
            "reached in them."
        )


_OF_ENVS = (SyncVectorEnv, AsyncVectorEnv)


def _mode_of(env: VectorEnv, chosen: str | AutoresetMode | None) -> AutoresetMode:
    mode = env.metadata.get("autoreset_mode") if chosen is None else chosen
    try:
        return AutoresetMode(mode)
    except ValueError:
        raise ParameterError(
            f"{env} does not declare how it resets: its autoreset mode is {mode!r}. Pass "
            "autoreset_mode='NextStep', 'SameStep' or 'Disabled'; if it returns the first "
            "observation of a new episode together with done, that is 'SameStep'."
        ) from None


def _refuse_reset_steps(env: VectorEnv, mode: AutoresetMode) -> None:
    """Only Gymnasium's own environments are known to leave no reset pending after a masked one."""
    bare = env.unwrapped
    if mode is AutoresetMode.SAME_STEP or isinstance(bare, SyncVectorEnv):
        return
    if isinstance(bare, AsyncVectorEnv):
        # Its workers drop a pending reset only with shared memory (Gymnasium 1.4).
        if not bare.shared_memory:
            raise ParameterError(
                "An AsyncVectorEnv without shared memory resets copies a second time after "
                "reset_mask. Make it with shared_memory=True or autoreset_mode=SAME_STEP."
            )
    elif mode is AutoresetMode.NEXT_STEP:
        raise ParameterError(
            f"{env} resets a copy in the step after its end. That step is no transition, but SB3 "
            "would store it. Make it with autoreset_mode=SAME_STEP (gymnasium.make_vec(..., "
            "vectorization_mode='sync') has it), or pass partial_reset=, which resets some copies "
            "only."
        )


def _seed_of(seeds: Sequence[int | None]) -> Any:
    """One number where seeds count up, as ``VecEnv.seed`` sets them: not all take lists."""
    first = seeds[0]
    if first is None or list(seeds) != list(range(first, first + len(seeds))):
        return None if set(seeds) == {None} else list(seeds)
    return first


def _options_of(options: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    if any(other != options[0] for other in options):
        raise ParameterError(
            f"Gymnasium resets all copies with the same options, got {list(options)}. "
            "Pass set_options() one dictionary."
        )
    return dict(options[0]) or None


def infos_of(infos: Mapping[str, Any] | Sequence[Mapping[str, Any]], n: int) -> list[dict]:
    """
    :param infos: by name one entry per copy and, under ``_name``, the mask of copies that have it;
        or one dictionary per copy already (``DictInfoToList``)
    :param n: number of copies
    :return: one dictionary per copy, with the entries that it has
    """
    if not isinstance(infos, Mapping):
        return [dict(info) for info in infos]
    rows: list[dict] = [{} for _ in range(n)]
    for name, value in infos.items():
        if name.startswith("_") and name[1:] in infos:
            continue
        parts: Any = infos_of(value, n) if isinstance(value, Mapping) else _one_each(value, n)
        has_it = infos.get(f"_{name}", np.ones(n, bool))
        for i in np.flatnonzero(has_it).tolist():
            rows[i][name] = parts[i]
    return rows


def obs_of(obs: Any, i: int) -> Any:
    """:return: the observation of environment ``i``, copied"""
    if isinstance(obs, Mapping):
        return {name: obs_of(part, i) for name, part in obs.items()}
    return np.array(obs[i])


def copied(obs: Any) -> Any:
    """:return: a deep copy: environments may reuse their buffers"""
    if isinstance(obs, Mapping):
        return {name: copied(part) for name, part in obs.items()}
    return np.array(obs)


def same_rows(first: Any, second: Any, rows: np.ndarray) -> bool:
    """:return: whether the observations of these copies are equal"""
    if isinstance(first, Mapping):
        return all(same_rows(part, second[name], rows) for name, part in first.items())
    return np.array_equal(np.asarray(first)[rows], np.asarray(second)[rows], equal_nan=True)


def _one_each(value: Any, n: int) -> Any:
    """Entries that are not one per copy hold for all copies."""
    each = isinstance(value, np.ndarray | Sequence) and not isinstance(value, str)
    return value if each and len(value) == n else [value] * n
