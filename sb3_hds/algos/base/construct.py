"""The ways in which an algorithm may be called."""

import inspect
import math
import numbers
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import jax
import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_hds.algos import registry
from sb3_hds.algos.base.checks import check_action_space, checked_env
from sb3_hds.algos.twin.epoch import PLANNERS
from sb3_hds.errors import EnvironmentMismatchError, did_you_mean

if TYPE_CHECKING:
    from sb3_hds.algos.twin.algorithm import TwinAlgorithm

# Counts, with the least that makes sense. Where None is the default, it means: derived.
_AT_LEAST = {
    "n_rollouts": 1,
    "horizon": 1,
    "lookahead": 0,
    "n_iterations": 1,
    "n_step_sizes": 2,
    "n_random_plans": 0,
    "plan_memory": 1,
    "compare_every": 0,
    "pretrain_epochs": 0,
    "batch_size": 1,
    "gradient_steps": -1,
    "refit_freq": 0,
    "replan_epochs": 0,
    "diagnose_freq": 0,
    "max_saved_steps": 1,
}
_DERIVED = ("horizon", "lookahead")
_SHARES = (
    "reset_share",
    "relabel_share",
    "random_share",
    "learned_share",
    "gain_weight",
    "sensitivity_weight",
    "averaging",
    "exploration_decay",
    "temperature_decay",
)
_OF_RESIDUAL = ("n_members", "net_arch", "caution")
# What the constructors of policies are given by their algorithm, and what only SB3's have.
_OF_ALGORITHMS = ("observation_space", "action_space", "lr_schedule", "use_sde")
_OF_TORCH = (
    "features_extractor_class",
    "features_extractor_kwargs",
    "share_features_extractor",
    "normalize_images",
)
_CHOICES = {
    "order": (1, 2),
    "planner": (None, *PLANNERS),
    "loss": ("smooth_absolute", "squared"),
}


def policy_and_env(
    algorithm: type[BaseAlgorithm],
    policy: Any,
    env: Any,
    check: Callable[[spaces.Space], None],
    monitor_wrapper: bool,
) -> tuple[Any, Any]:
    """
    A lone environment, or a lone string that names no policy, is the environment:
    ``HDS("Pendulum-v1")`` means ``HDS("MlpPolicy", "Pendulum-v1")``.

    :param check: raises for observations that the algorithm cannot use
    :param monitor_wrapper: whether SB3 may wrap a lone environment in its ``Monitor``
    :return: policy and environment in SB3's order; the environment made, if it was a string
    :raises EnvironmentMismatchError: for what is no environment, and for observations and actions
        that the algorithm cannot use
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
            # SBX does not hand the argument on to SB3, which leaves vectorised ones as they are.
            env = DummyVecEnv([partial(_itself, env)])
    return _checked_policy(algorithm, policy), env


def _itself(env: gym.Env) -> gym.Env:
    return env


def check_twin_observes(space: spaces.Space) -> None:
    """
    :raises EnvironmentMismatchError: for dictionaries, images and whatever else no twin has
    """
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise EnvironmentMismatchError(
            f"A twin observes a Box with one axis, and this environment observes {space}. Use one "
            "that has a twin (sb3_hds.twins.all_ids() lists them), or make your own of its state."
        )


def check_policy_kwargs(policy: type, policy_kwargs: Iterable[str]) -> None:
    """
    :param policy: a class
    :param policy_kwargs: names of what it is made with, besides what algorithms pass
    :raises TypeError: for what it has no argument of, as Python does
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
    :return: the policy, a class where it was the name of one
    :raises ValueError: for a name that the algorithm does not know, and for a policy class of
        another algorithm, as its saved files name it
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
    :param saved_by: name of the class whose arguments a model has
    :raises ValueError: if that is neither this class nor one that it extends
    """
    if saved_by not in (parent.__name__ for parent in algorithm.__mro__):
        raise ValueError(
            f"{saved_by} saved this model: use {saved_by}.load, not {algorithm.__name__}.load."
        )


def check_arguments(model: "TwinAlgorithm") -> None:
    """
    Everything that would otherwise fail inside a compiled program, or in the middle of training.

    :raises ValueError: naming the argument, what it may be and what it is
    """
    for name, allowed in _broken_rules(model):
        raise ValueError(
            f"{type(model).__name__}({name}={getattr(model, name)!r}): {name} must be {allowed}."
        )
    if model.value_learning_rate is not None:
        schedule_of(model.value_learning_rate)


def _broken_rules(model: "TwinAlgorithm") -> Iterator[tuple[str, str]]:
    for name, least in _AT_LEAST.items():
        if hasattr(model, name) and not is_count(
            getattr(model, name), least, may_be_none=name in _DERIVED
        ):
            yield name, f"a whole number of at least {least}" + " or None" * (name in _DERIVED)
    for name in _SHARES:
        if not between(getattr(model, name), 0.0, 1.0):
            yield name, "a number from 0 to 1"
    for name in ("temperature", "exploration_noise", "least_gain", "randomisation"):
        if not between(getattr(model, name), 0.0, math.inf):
            yield name, "a finite number of at least 0"
    if not (between(model.gamma, 0.0, 1.0) and model.gamma > 0.0):
        yield "gamma", "a number above 0 and at most 1"
    for name in ("learning_rate", "value_learning_rate"):
        rate = getattr(model, name)
        if isinstance(rate, numbers.Real) and not between(rate, 0.0, math.inf):
            yield name, "a finite number of at least 0, or a schedule"
    beta, kwargs = getattr(model, "beta", "auto"), getattr(model, "residual_kwargs", None)
    if beta != "auto" and not between(beta, 0.0, 1.0):
        yield "beta", "'auto' or a number from 0 to 1"
    if not set(kwargs or ()) <= set(_OF_RESIDUAL):
        yield "residual_kwargs", f"a dictionary with some of {', '.join(_OF_RESIDUAL)}"
    for name, choices in _CHOICES.items():
        if getattr(model, name) not in choices:
            yield name, f"one of {', '.join(map(repr, choices))}"


def is_count(value: Any, least: int, may_be_none: bool = False) -> bool:
    """:return: whether it is a whole number of at least ``least``"""
    if value is None:
        return may_be_none
    return isinstance(value, int | np.integer) and int(value) >= least


def check_count(name: str, value: Any, least: int = 1) -> None:
    """
    :raises ValueError: unless it is a whole number of at least ``least``
    """
    if not is_count(value, least):
        raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}.")


def between(value: Any, low: float, high: float) -> bool:
    """:return: whether it is a finite number from ``low`` to ``high``"""
    if not isinstance(value, numbers.Real):
        return False
    return low <= float(value) <= high and math.isfinite(value)


def schedule_of(rate: float | str | Schedule) -> Schedule:
    """
    :param rate: a number, a function of the remaining progress (from 1 to 0), or ``"lin_3e-3"`` as
        in the zoo
    :raises ValueError: for any other string, and for a negative number in one
    """
    if not isinstance(rate, str):
        return FloatSchedule(float(rate) if isinstance(rate, numbers.Real) else rate)
    kind, _, after = rate.partition("_")
    try:
        start = float(after if kind == "lin" else rate)
    except ValueError:
        start = math.nan
    if not between(start, 0.0, math.inf):
        raise ValueError(
            f"A learning rate is a number of at least 0, a schedule or 'lin_NUMBER', got {rate!r}."
        )
    return FloatSchedule(LinearSchedule(start, 0.0, 1.0) if kind == "lin" else start)


def device_or_cpu(device: Any) -> Any:
    """
    A model that was trained on an accelerator must load where there is none: as in SB3, ``"cuda"``
    then means the CPU.

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
