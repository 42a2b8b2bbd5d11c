"""Call forms of the constructors, and checks of arguments whose errors say how to fix the call."""

import inspect
import math
import numbers
import warnings
from collections.abc import Callable, Iterable
from typing import Any

import gymnasium as gym
import jax
import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from stable_baselines3.common.base_class import BaseAlgorithm, maybe_make_env
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.her import HerReplayBuffer

from sb3_hds.algos import registry
from sb3_hds.algos.base.config import is_whole
from sb3_hds.errors import EnvironmentMismatchError, did_you_mean

# Characters of a value that a message shows.
_LONGEST = 200
_GOALS = {"observation", "achieved_goal", "desired_goal"}
# Arguments of policies that their algorithm passes, and those that only SB3's policies have.
_OF_ALGORITHMS = ("observation_space", "action_space", "lr_schedule", "use_sde")
_OF_TORCH = (
    "features_extractor_class",
    "features_extractor_kwargs",
    "share_features_extractor",
    "normalize_images",
)


def policy_and_env(
    algorithm: type[BaseAlgorithm],
    policy: Any,
    env: Any,
    check: Callable[[spaces.Space], None],
    monitor_wrapper: bool,
) -> tuple[Any, Any]:
    """
    A single argument that names no policy is the environment: ``HDS("Pendulum-v1")`` means
    ``HDS("MlpPolicy", "Pendulum-v1")``.

    :param check: raises for observations that the algorithm cannot use
    :param monitor_wrapper: whether SB3 may wrap an environment that is not vectorised in
        ``Monitor``
    :return: policy and environment in SB3's order; an id is replaced by its environment
    :raises EnvironmentMismatchError: unless ``env`` is an environment with observations and actions
        that the algorithm can use
    :raises ValueError: for a policy that it cannot use
    """
    names_env = isinstance(policy, str) and not policy.endswith("Policy")
    if env is None and (names_env or isinstance(policy, gym.Env | VecEnv | VectorEnv)):
        policy, env = None, policy
    if env is not None:
        env = checked_env(algorithm, env)
        check_action_space(algorithm, env.action_space)
        check(env.observation_space)
        of_several = isinstance(env.observation_space, spaces.Dict)
        policy = policy or ("MultiInputPolicy" if of_several else "MlpPolicy")
        if isinstance(env, gym.Env) and not monitor_wrapper:
            # SBX does not pass the argument on to SB3, which wraps no vectorised environment.
            env = DummyVecEnv([lambda made=env: made])
    return _checked_policy(algorithm, policy), env


def check_policy_kwargs(policy: type, policy_kwargs: Iterable[str]) -> None:
    """
    :param policy: a class
    :param policy_kwargs: names of the arguments that the user passes
    :raises TypeError: for a name that is none of its arguments
    """
    parameters = inspect.signature(policy).parameters
    if any(each.kind is inspect.Parameter.VAR_KEYWORD for each in parameters.values()):
        return
    known = [name for name in parameters if name not in _OF_ALGORITHMS]
    for name in policy_kwargs:
        if name in parameters:
            continue
        way_out = did_you_mean(name, known) or f" It has: {', '.join(known)}."
        if name in _OF_TORCH:
            way_out = " It is for modules of torch, and networks here are JAX's: leave it out."
        raise TypeError(
            f"policy_kwargs={{'{name}': ...}}: {policy.__name__} has no such argument.{way_out}"
        )


def _checked_policy(algorithm: Any, policy: Any) -> Any:
    """
    :return: the policy; the name of a policy class in saved files is replaced by the class
    :raises ValueError: for a name that the algorithm does not know, and for a policy class of
        another algorithm
    """
    known = algorithm.policy_aliases
    if isinstance(policy, str) and policy not in known:
        if policy in registry.POLICIES:  # as saved files name them
            return _checked_policy(algorithm, registry.load(policy))
        raise ValueError(f"{algorithm.__name__} has no policy {policy!r}: use {', '.join(known)}.")
    if isinstance(policy, type) and not issubclass(policy, algorithm.policy_family):
        raise ValueError(
            f"{algorithm.__name__} cannot use the policy {policy.__name__}: pass 'MlpPolicy'. "
            "A file that another algorithm saved is loaded by the class of that algorithm."
        )
    return policy


def check_origin(algorithm: type, saved_by: str) -> None:
    """
    :param saved_by: name of the class that saved the model
    :raises ValueError: unless that is this class or one that it extends
    """
    if saved_by not in (parent.__name__ for parent in algorithm.__mro__):
        raise ValueError(
            f"{saved_by} saved this model: use {saved_by}.load, not {algorithm.__name__}.load."
        )


def in_one_line(what: Any) -> str:
    """:return: ``str(what)`` without line breaks, shortened for a message"""
    text = " ".join(str(what).split())
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


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
    """:raises EnvironmentMismatchError: unless actions are a Box with finite limits"""
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
    :param kind: class of the replay buffer; None: the default
    :raises EnvironmentMismatchError: for ``HerReplayBuffer`` with observations that have no goals
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
    :param buffer: object that was read from ``path``
    :raises EnvironmentMismatchError: unless it is a replay buffer of an environment like the
        model's
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
    """:raises EnvironmentMismatchError: if there is nothing to learn in"""
    if model.env is None:
        name = type(model).__name__
        raise EnvironmentMismatchError(
            f"{name} has no environment to learn in: call set_env(env), or load it with one, as "
            f"{name}.load(path, env=env)."
        )


def checked_timesteps(total_timesteps: Any) -> int:
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
    """:raises ValueError: unless it is None or a whole number of at least 1"""
    if log_interval is not None and not (is_whole(log_interval) and log_interval >= 1):
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
    :param given: a list of names and of objects of class ``kind``, or a single one of them
    :raises TypeError: for anything else
    """
    several = [given] if isinstance(given, str | kind) else given
    if not isinstance(several, Iterable) or not all(isinstance(x, str | kind) for x in several):
        raise TypeError(
            f"{name}={in_one_line(given)}: {name} must be a list of names, or of objects of "
            f"{kind.__name__}."
        )
    return list(several)


def device_or_cpu(device: Any) -> Any:
    """
    As in SB3, a model that was trained on an accelerator loads on the CPU where there is none.

    :return: ``device``, or ``"cpu"``, with a warning
    """
    if str(device).partition(":")[0] != "cuda":
        return device
    try:
        jax_device(device)
    except ValueError:
        warnings.warn(f"There is no '{device}' that JAX could use; the model is loaded on the CPU.")
        return "cpu"
    return device


def jax_device(device: Any) -> Any:
    """
    :param device: ``"auto"``, ``"cpu"``, ``"cuda"``, ``"cuda:1"`` or a ``torch.device``
    :return: the JAX device of that name
    :raises ValueError: if JAX has no such device
    """
    kind, _, index = str(device).partition(":")
    if kind == "auto":
        return jax.devices()[0]
    platform = {"cuda": "gpu"}.get(kind, kind)
    try:
        return jax.devices(platform)[int(index or 0)]
    except (RuntimeError, IndexError, ValueError):
        available = ", ".join(str(d) for d in jax.devices())
        raise ValueError(
            f"device='{device}' asks for something JAX does not have here; it has: {available}. "
            "Use device='auto', or install JAX for your accelerator (pip install 'jax[cuda13]')."
        ) from None
