"""What an algorithm may be given by mistake: one line each that says what to do instead."""

import inspect
import math
import numbers
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.her import HerReplayBuffer

from sb3_hds.errors import EnvironmentMismatchError, did_you_mean

_LONGEST = 200
_LARGEST_SEED = 2**32 - 1
_GOALS = {"observation", "achieved_goal", "desired_goal"}
# What SB3's ``load`` may change besides arguments of the constructor.
_OF_LOAD = ("custom_objects", "print_system_info", "force_reset", "n_envs", "num_timesteps")


def in_one_line(what: Any) -> str:
    """:return: as it prints itself, shortened"""
    text = " ".join(str(what).split())
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def check_given(algorithm: type, given: Mapping[str, Any], loading: bool = False) -> None:
    """
    :param given: to the constructor, or to ``load``, by name
    :raises TypeError: for an argument that the algorithm does not have, and for what is no
        dictionary or seed where one is needed
    :raises ValueError: for a seed out of range
    """
    own = _parameters(algorithm)
    known = [*(own or ()), *(_OF_LOAD if loading else ())]
    for name in given:
        if own is not None and name not in known:
            public = [each for each in known if not each.startswith("_")]
            way_out = did_you_mean(name, public) or f" It has: {', '.join(public)}."
            raise TypeError(f"{algorithm.__name__} has no argument '{name}'.{way_out}")
    for name in ("policy_kwargs", "replay_buffer_kwargs"):
        if not isinstance(given.get(name) or {}, Mapping):
            raise TypeError(
                f"{algorithm.__name__}({name}={given[name]!r}): {name} must be a dictionary, such "
                "as {'net_arch': [64, 64]}, or None."
            )
    seed = given.get("seed")
    if seed is not None and not (_is_whole(seed) and 0 <= seed <= _LARGEST_SEED):
        kind = ValueError if _is_whole(seed) else TypeError
        raise kind(
            f"{algorithm.__name__}(seed={seed!r}): seed must be None or a whole number from 0 to "
            f"{_LARGEST_SEED}."
        )


def checked_env(algorithm: type, env: Any) -> Any:
    """
    :param env: an environment, or its id
    :return: the environment
    :raises EnvironmentMismatchError: for anything else
    """
    name = algorithm.__name__
    aliases = getattr(algorithm, "policy_aliases", {})
    if isinstance(env, str) and env in aliases:
        raise EnvironmentMismatchError(
            f"{name}(env={env!r}): that is a policy. The policy comes first, as in "
            f"{name}({env!r}, 'Pendulum-v1')."
        )
    made = maybe_make_env(env, 0)
    if isinstance(made, VectorEnv):
        raise EnvironmentMismatchError(
            f"{name} takes no vectorised environment of Gymnasium: wrap it in "
            "sb3_hds.wrappers.GymnasiumVecEnv(env)."
        )
    needed = ("observation_space", "action_space", "reset", "step")
    if isinstance(made, type) or not all(hasattr(made, each) for each in needed):
        what = "a class or function: call it first" if callable(made) else "no environment"
        raise EnvironmentMismatchError(
            f"{name}(env={in_one_line(made)}): that is {what}. Pass an environment, as from "
            "gymnasium.make('Pendulum-v1'), its id, or a VecEnv of SB3."
        )
    return made


def check_action_space(algorithm: type, space: spaces.Space) -> None:
    """
    :raises EnvironmentMismatchError: unless actions are a Box with finite limits
    """
    name = algorithm.__name__
    if not isinstance(space, spaces.Box):
        raise EnvironmentMismatchError(
            f"{name} acts by real numbers: it only supports a Box as action space, and this "
            f"environment has {in_one_line(space)}. For choices, use DQN or PPO of "
            "stable_baselines3."
        )
    with np.errstate(over="ignore"):
        width = np.asarray(space.high, np.float32) - np.asarray(space.low, np.float32)
    if not np.isfinite(width).all():
        raise EnvironmentMismatchError(
            f"{name} needs a finite lower and upper bound of each action, which it scales to [-1, "
            f"1], and this environment has {in_one_line(space)}. Say what is sensible: "
            "gymnasium.wrappers.TransformAction(env, lambda action: action, gymnasium.spaces.Box("
            "low, high))."
        )


def check_buffer_class(algorithm: type, kind: Any, space: spaces.Space) -> None:
    """
    :param kind: of replay buffers; None: the usual one
    :raises EnvironmentMismatchError: for hindsight where there are no goals
    """
    relabels = isinstance(kind, type) and issubclass(kind, HerReplayBuffer)
    names = set(space.spaces) if isinstance(space, spaces.Dict) else set()
    if relabels and not names >= _GOALS:
        raise EnvironmentMismatchError(
            f"{algorithm.__name__}(replay_buffer_class=HerReplayBuffer) relabels goals: it needs "
            "observations that are a Dict with observation, achieved_goal and desired_goal, and "
            f"this environment observes {in_one_line(space)}. Leave replay_buffer_class out, or "
            "use an environment with goals (gymnasium_robotics)."
        )


def check_buffer(model: Any, buffer: Any, path: Any) -> None:
    """
    :param buffer: that was read
    :raises EnvironmentMismatchError: if it is of another environment, or none
    """
    if not isinstance(buffer, ReplayBuffer):
        raise EnvironmentMismatchError(
            f"'{path}' holds a {type(buffer).__name__}, no replay buffer: pass the file that "
            "save_replay_buffer wrote."
        )
    for name in ("observation_space", "action_space", "n_envs"):
        own, its = getattr(model, name), getattr(buffer, name, None)
        if its is not None and its != own:
            raise EnvironmentMismatchError(
                f"The replay buffer in '{path}' is of another environment: its {name} is "
                f"{in_one_line(its)}, this model's {in_one_line(own)}. Load it into a model with "
                "the environment that it was filled in."
            )


def check_has_env(model: Any) -> None:
    """
    :raises EnvironmentMismatchError: if there is nothing to learn in
    """
    if model.env is None:
        name = type(model).__name__
        raise EnvironmentMismatchError(
            f"{name} has no environment to learn in: call set_env(env), or load it with one, as "
            f"{name}.load(path, env=env)."
        )


def whole_steps(total_timesteps: Any) -> int:
    """
    :param total_timesteps: also as 1e5
    :raises ValueError: unless it is a whole number of at least 0
    """
    number = float(total_timesteps) if isinstance(total_timesteps, numbers.Real) else math.nan
    if not (number.is_integer() and number >= 0.0):
        raise ValueError(
            f"learn(total_timesteps={total_timesteps!r}): total_timesteps must be a whole number "
            "of steps of at least 0."
        )
    return int(number)


def check_log_interval(log_interval: Any) -> None:
    """
    :raises ValueError: unless it is None or a whole number of at least 1
    """
    if log_interval is not None and not (_is_whole(log_interval) and log_interval >= 1):
        raise ValueError(
            f"learn(log_interval={log_interval!r}): log_interval must be None, for no log, or a "
            "whole number of at least 1."
        )


def callbacks_of(given: Any) -> list[BaseCallback]:
    """
    :param given: a callback, a function of ``locals`` and ``globals``, a list of these, or None
    :raises TypeError: for anything else
    """
    several = list(given) if isinstance(given, list | tuple) else [given]
    found = [each for each in several if each is not None]
    if not all(callable(each) or isinstance(each, BaseCallback) for each in found):
        raise TypeError(
            f"learn(callback={in_one_line(given)}): callback must be a BaseCallback of SB3, a "
            "function of locals and globals, or a list of these."
        )
    return [each if isinstance(each, BaseCallback) else ConvertCallback(each) for each in found]


def as_list(name: str, given: Any, kind: type) -> list[Any]:
    """
    :param name: of the argument
    :param given: names or objects of a kind, or a single one
    :raises TypeError: for anything else
    """
    several = [given] if isinstance(given, str | kind) else given
    if not isinstance(several, Iterable) or not all(isinstance(x, str | kind) for x in several):
        raise TypeError(
            f"{name}={in_one_line(given)}: {name} must be a list of names, or of objects of "
            f"{kind.__name__}."
        )
    return list(several)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _parameters(algorithm: type) -> list[str] | None:
    """
    :return: of its constructor, and of those to which that passes on what it does not know; None
        where somebody's own constructor may take what it likes out of that
    """
    names: dict[str, None] = {}
    for base in algorithm.__mro__:
        if "__init__" not in vars(base):
            continue
        own = inspect.signature(base.__init__).parameters
        passed_on = [each for each in own.values() if each.kind is each.VAR_KEYWORD]
        names |= dict.fromkeys(
            name
            for name, each in own.items()
            if each.kind not in (each.VAR_KEYWORD, each.VAR_POSITIONAL) and name != "self"
        )
        if not passed_on:
            break
        if not base.__module__.startswith("sb3_hds."):
            return None
    return list(names)
