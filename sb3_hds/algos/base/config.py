"""
Arguments of constructors.

Each algorithm has one frozen dataclass, whose fields are its arguments with their defaults,
documentation and checks. :func:`takes` turns it into a constructor whose signature editors,
``help`` and ``inspect.signature`` show.
"""

import dataclasses
import functools
import inspect
import math
import numbers
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY
from typing import Any, ClassVar, Concatenate, ParamSpec, TypeVar

import numpy as np
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule, TrainFrequencyUnit
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule

from sb3_hds.errors import did_you_mean

P = ParamSpec("P")
AnyConfig = TypeVar("AnyConfig")
Rate = float | str | Schedule

_LARGEST_SEED = 2**32 - 1
# Arguments of SB3's ``load`` that are not arguments of the constructor.
_OF_LOAD = ("custom_objects", "print_system_info", "force_reset", "n_envs", "num_timesteps")


def takes(
    config: Callable[P, AnyConfig],
) -> Callable[[Callable[[Any, AnyConfig], None]], Callable[Concatenate[Any, P], None]]:
    """
    Decorate a constructor that takes a config: it takes the config's fields instead, and calls
    ``set_up`` at its end.

    :param config: a dataclass
    """

    def decorate(construct: Callable[[Any, AnyConfig], None]) -> Any:
        @functools.wraps(construct)
        def construct_from_fields(self: Any, *args: P.args, **kwargs: P.kwargs) -> None:
            # SB3's private argument: ``load`` sets a model up later.
            set_up = kwargs.pop("_init_setup_model", True)
            check_known(type(self), config, kwargs)
            construct(self, config(*args, **kwargs))
            if set_up:
                self.set_up()

        own = inspect.signature(construct).parameters["self"]
        signature = inspect.signature(config)
        arguments = [own, *signature.parameters.values()]
        made: Any = construct_from_fields
        made.__signature__ = signature.replace(parameters=arguments)
        made.__doc__ = _documentation(config)
        return made

    return decorate


def _documentation(config: Any) -> str:
    """:return: the ``:param:`` entry of every field, from the most derived config that has one"""
    found: dict[str, str] = {}
    for kind in reversed(config.__mro__):
        text = inspect.cleandoc(kind.__doc__ or "")
        for name, words in re.findall(r"^:param (\w+):((?:.|\n)*?)(?=^:|\Z)", text, re.MULTILINE):
            found[name] = f":param {name}:{words.rstrip()}"
    return "\n".join(found[name] for name in arguments_of(config))


def arguments_of(config: Any) -> list[str]:
    """:return: names of the fields that are arguments; others are constants"""
    return [field.name for field in dataclasses.fields(config) if field.init]


def check_known(algorithm: type, config: Any, given: Mapping[str, Any], loading: bool = False):
    """
    :param given: arguments of the constructor, or of ``load``, by name
    :raises TypeError: for one that the algorithm does not have
    """
    known = arguments_of(config)
    also = (*_OF_LOAD, "_init_setup_model") if loading else ()
    for name in given:
        if name not in (*known, *also):
            way_out = did_you_mean(name, known) or f" It has: {', '.join(known)}."
            raise TypeError(f"{algorithm.__name__} has no argument '{name}'.{way_out}")


@dataclasses.dataclass(frozen=True, eq=False)
class Config:
    """
    Arguments of every algorithm.

    :param policy: ``"MlpPolicy"``, a policy class, or the environment itself
    :param env: an environment, its id, or a vectorised environment
    :param policy_kwargs: arguments of the policy
    :param stats_window_size: episodes in the logged averages
    :param tensorboard_log: folder for TensorBoard
    :param verbose: 0: no output, 1: information, 2: debugging
    :param seed: of all random numbers
    :param device: ``"auto"``, ``"cpu"`` or ``"cuda"``, as in JAX
    :param monitor_wrapper: whether SB3 may wrap the environment in its ``Monitor``
    """

    policy: str | type[BasePolicy] | GymEnv = "MlpPolicy"
    env: GymEnv | str | None = None
    _: KW_ONLY
    policy_kwargs: dict[str, Any] | None = None
    stats_window_size: int = 100
    tensorboard_log: str | None = None
    verbose: int = 0
    seed: int | None = None
    device: str = "auto"
    monitor_wrapper: bool = True
    #: arguments that may be None and are then derived from others
    derived: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def of(cls, model: Any) -> Any:
        """:return: the current values of the arguments, from the model's attributes, checked"""
        attributes = vars(model)
        names = [name for name in arguments_of(cls) if name in attributes and name not in _OBJECTS]
        return cls(**{name: attributes[name] for name in names})

    def __post_init__(self) -> None:
        """
        :raises ValueError: for a value out of range
        :raises TypeError: for a value of the wrong type
        """
        self._require_mapping("policy_kwargs")
        seed = self.seed
        if seed is not None and not (is_whole(seed) and 0 <= seed <= _LARGEST_SEED):
            kind = ValueError if is_whole(seed) else TypeError
            allowed = f"None or a whole number from 0 to {_LARGEST_SEED}"
            raise kind(self._objection("seed", allowed))

    def require(self, fine: bool, name: str, allowed: str) -> None:
        """
        :param fine: whether the value is allowed
        :param name: of the argument
        :param allowed: which values are, for the message
        :raises ValueError: unless ``fine``
        """
        if not fine:
            raise ValueError(self._objection(name, allowed))

    def require_counts(self, fewest: Mapping[str, int]) -> None:
        """:param fewest: smallest allowed value of each argument"""
        for name, least in fewest.items():
            may_be_none = name in self.derived
            allowed = f"a whole number of at least {least}" + " or None" * may_be_none
            self.require(is_count(getattr(self, name), least, may_be_none), name, allowed)

    def require_range(self, low: float, high: float, allowed: str, *names: str) -> None:
        """:param names: of arguments that must be finite numbers from ``low`` to ``high``"""
        for name in names:
            self.require(between(getattr(self, name), low, high), name, allowed)

    def require_choice(self, name: str, choices: Sequence[Any]) -> None:
        """:param choices: allowed values"""
        allowed = f"one of {', '.join(map(repr, choices))}"
        self.require(getattr(self, name) in choices, name, allowed)

    def require_flag(self, name: str) -> None:
        self.require(isinstance(getattr(self, name), bool | np.bool_), name, "True or False")

    def is_default(self, name: str) -> bool:
        """:return: whether the argument has its default value"""
        defaults = {field.name: field.default for field in dataclasses.fields(self)}
        return getattr(self, name) == defaults[name]

    def _require_mapping(self, name: str) -> None:
        value = getattr(self, name)
        if not (value is None or isinstance(value, Mapping)):
            raise TypeError(
                self._objection(name, "a dictionary, such as {'net_arch': [64, 64]}, or None")
            )

    def _objection(self, name: str, allowed: str) -> str:
        algorithm = type(self).__name__.removesuffix("Config")
        return f"{algorithm}({name}={getattr(self, name)!r}): {name} must be {allowed}."


# Attributes of a model that are objects made of the arguments of the same name.
_OBJECTS = ("policy", "env")


@dataclasses.dataclass(frozen=True, eq=False)
class OffPolicyConfig(Config):
    """
    Arguments of every algorithm that learns from a replay buffer.

    :param learning_rate: number, schedule or ``"lin_3e-4"``
    :param buffer_size: capacity of the replay buffer [transitions]
    :param learning_starts: steps with random actions before learning starts
    :param batch_size: samples per gradient step
    :param gamma: discount per step of the environment
    :param train_freq: steps between two calls of ``train``, or ``(n, "episode")``
    :param gradient_steps: per call of ``train``; -1: as many as environment steps since the last
    :param action_noise: added to the actions
    """

    learning_rate: Rate = 3e-4
    _: KW_ONLY
    buffer_size: int = 1_000_000
    learning_starts: int = 100
    batch_size: int = 256
    gamma: float = 0.99
    train_freq: int | tuple[int, str] | None = 1
    gradient_steps: int = 1
    action_noise: ActionNoise | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_counts(
            {"buffer_size": 1, "learning_starts": 0, "batch_size": 1, "gradient_steps": -1}
        )
        fine = _is_frequency(self.train_freq) or (
            self.train_freq is None and "train_freq" in self.derived
        )
        self.require(fine, "train_freq", "a number of at least 1, or (n, 'episode')")
        fine = self.action_noise is None or isinstance(self.action_noise, ActionNoise)
        self.require(fine, "action_noise", "None or an ActionNoise of SB3")
        self.require_rate("learning_rate")

    def require_rate(self, name: str) -> None:
        """:param name: of a learning rate"""
        rate = getattr(self, name)
        fine = callable(rate) or isinstance(rate, str) or between(rate, 0.0, math.inf)
        self.require(fine, name, "a finite number of at least 0, or a schedule")
        if isinstance(rate, str):
            schedule_of(rate)


def _is_frequency(given: Any) -> bool:
    fewest, unit = given if isinstance(given, tuple) and len(given) == 2 else (given, "step")
    units = [each.value for each in TrainFrequencyUnit]
    return is_count(fewest, 1) and getattr(unit, "value", unit) in units


def is_whole(value: Any) -> bool:
    """:return: whether it is a whole number, of Python or NumPy"""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def is_count(value: Any, least: int, may_be_none: bool = False) -> bool:
    """:return: whether it is a whole number of at least ``least``"""
    if value is None:
        return may_be_none
    return is_whole(value) and int(value) >= least


def check_count(name: str, value: Any, least: int = 1) -> None:
    """:raises ValueError: unless it is a whole number of at least ``least``"""
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
    :raises ValueError: for any other string, and for a negative number in a string
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
