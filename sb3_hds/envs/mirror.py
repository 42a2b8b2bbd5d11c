"""
The twin of an environment, whatever its vectorisation and wrappers.

Neutral wrappers, which do not change observations, actions or rewards, are skipped. Wrappers with a
``twin_transform`` are applied to the twin as well. Any other wrapper raises an error that names it,
because planning without it would be silently wrong.
"""

import contextlib
import dataclasses
import re
from collections.abc import Iterable, Iterator, Sequence

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
    VecVideoRecorder,
)

from sb3_hds.core import StatefulTransform, TransformedTwin, Twin
from sb3_hds.envs.twin_env import TwinEnv
from sb3_hds.envs.twin_vec_env import TwinVecEnv
from sb3_hds.errors import EnvironmentMismatchError, NoTwinError
from sb3_hds.twins import registry

# Class name -> its package. rl_zoo3 replaces Gymnasium's TimeLimit by its own.
_NEUTRAL = {
    "Autoreset": "gymnasium",
    "HumanRendering": "gymnasium",
    "InfiniteHorizon": "sb3_hds",
    "ManualReset": "sb3_hds",
    "Monitor": "stable_baselines3",
    "OrderEnforcing": "gymnasium",
    "PassiveEnvChecker": "gymnasium",
    "PatchedTimeLimit": "rl_zoo3",
    "RecordEpisodeStatistics": "gymnasium",
    "RecordVideo": "gymnasium",
    "RenderCollection": "gymnasium",
    "TimeLimit": "gymnasium",
}
# The learners apply VecNormalize themselves.
_NEUTRAL_VEC = (VecCheckNan, VecMonitor, VecNormalize, VecVideoRecorder)

# ``str(env)`` nests: <Monitor<TimeLimit<PendulumEnv<Pendulum-v1>>>>
_ENCLOSING = re.compile(r"<(\w+)(?=<)")
_WITHOUT_ID = re.compile(r"<\w+ instance>")


def twin_of(env: gymnasium.Env | VecEnv) -> Twin:
    """
    Find the twin that mirrors an environment.

    :param env: an environment or a vectorised one (in this process or in others), wrapped or not
    :return: its twin, with the parameters that the environment was made with
    :raises EnvironmentMismatchError: for a wrapper that may change observations, actions or
        rewards, for copies with different parameters, or for spaces that twins do not support
    :raises NoTwinError: if no twin is registered for it
    """
    if isinstance(env, VecEnv):
        bare = env
        while isinstance(bare, VecEnvWrapper):
            if type(bare) not in _NEUTRAL_VEC:
                raise _not_neutral_error(type(bare).__name__, "VecEnv wrapper")
            bare = bare.venv
        twin = bare.twin if isinstance(bare, TwinVecEnv) else _common_twin(_twins_of_copies(bare))
    elif isinstance(env, gymnasium.Env):
        twin = _twin_of_one(env)
    else:
        raise TypeError(f"A gymnasium.Env or an SB3 VecEnv has a twin, got {env!r}.")
    check_mirrors(env, twin)
    return twin


def check_mirrors(env: gymnasium.Env | VecEnv, twin: Twin) -> None:
    """
    Check that a twin has the actions and the observations of an environment as wrapped.

    Steps are not compared: see :func:`~sb3_hds.envs.verify.verify_mirror`.

    :param env: as the learner receives it
    :param twin: used for planning
    :raises EnvironmentMismatchError: if actions are not a bounded Box, or if sizes or limits differ
    """
    low, high = _action_limits(env.action_space)
    names = ", ".join(a.name for a in twin.actuators)
    ours = np.array([(a.low, a.high) for a in twin.actuators], np.float64).T
    if low.size != len(twin.actuators):
        raise EnvironmentMismatchError(
            f"The environment takes {low.size} actions and {twin.name} has {len(twin.actuators)} "
            f"actuators ({names}). Pass a twin= of this environment as wrapped."
        )
    # Spaces are single precision.
    if not np.allclose((low, high), ours, rtol=1e-6, atol=0.0):
        raise EnvironmentMismatchError(
            f"The environment takes actions from {low.tolist()} to {high.tolist()}, and the "
            f"actuators of {twin.name} ({names}) from {ours[0].tolist()} to {ours[1].tolist()}. "
            "Pass a twin= of this environment as wrapped, for example a TransformedTwin."
        )
    shape, wanted = env.observation_space.shape, (len(twin.channels),)
    if not isinstance(env.observation_space, spaces.Box) or shape != wanted:
        raise EnvironmentMismatchError(
            f"The environment observes {env.observation_space}, and {twin.name} observes a Box of "
            f"shape {wanted} ({', '.join(c.name for c in twin.channels)}). "
            "Pass a twin= of this environment as wrapped, for example a TransformedTwin."
        )


def _action_limits(space: spaces.Space) -> tuple[np.ndarray, np.ndarray]:
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise EnvironmentMismatchError(
            "Planning differentiates with respect to the action, so actions must be a Box "
            f"with one axis, got {space}. Use an environment with continuous actions."
        )
    if not space.is_bounded():
        raise EnvironmentMismatchError(
            f"Planning keeps actions within their limits, so these must be finite, got {space}. "
            "Give the environment's action_space finite bounds."
        )
    return space.low.astype(np.float64), space.high.astype(np.float64)


def _twin_of_one(env: gymnasium.Env) -> Twin:
    layer, transforms = env, []
    while isinstance(layer, gymnasium.Wrapper):
        transform = getattr(layer, "twin_transform", None)
        if isinstance(transform, StatefulTransform):
            transforms.append(transform)
        else:
            _check_neutral(type(layer).__name__, type(layer).__module__)
        layer = layer.env
    _action_limits(env.action_space)
    twin = layer.twin if isinstance(layer, TwinEnv) else registry.from_env(layer)
    return _transformed(twin, transforms)


def _transformed(twin: Twin, transforms: Iterable[StatefulTransform]) -> Twin:
    """:param transforms: of the wrappers, the outermost first"""
    for transform in reversed(list(transforms)):
        twin = TransformedTwin(twin, stateful=transform)
    return twin


def _twins_of_copies(env: VecEnv) -> list[Twin]:
    """The twin of each copy in this process (``DummyVecEnv``) or another (``SubprocVecEnv``)."""
    if isinstance(env, DummyVecEnv):
        return [_twin_of_one(copy) for copy in env.envs]
    layers = _transforms_of(env)
    transformed = {name for copy in layers for name, _ in copy}
    # Only after that check: a spec contains the arguments of wrappers, and sending a lambda kills
    # the process.
    with _no_twin_errors(env):
        specs = env.get_attr("spec")
    for spec in specs:
        for wrapper in spec.additional_wrappers if spec is not None else ():
            if wrapper.name not in transformed:
                _check_neutral(wrapper.name, wrapper.entry_point)
    _action_limits(env.action_space)
    own = env.get_attr("twin") if env.has_attr("twin") else []
    bare = own if own and all(isinstance(t, Twin) for t in own) else map(_twin_of_spec, specs)
    return [
        _transformed(twin, (transform for _, transform in copy))
        for twin, copy in zip(bare, layers, strict=True)
    ]


def _transforms_of(env: VecEnv) -> list[list[tuple[str, StatefulTransform]]]:
    """
    Names and transforms of the wrappers with a twin transform, for each copy in another process,
    the outermost first.

    :raises EnvironmentMismatchError: for a wrapper that is neither neutral nor has a twin transform
    :raises NoTwinError: if the wrappers of the copies are unknown
    """
    with _no_twin_errors(env):
        named = [_wrapper_names(text) for text in env.env_method("__str__")]
        has_transforms = env.has_attr("twin_transforms")
        copies = env.get_attr("twin_transforms") if has_transforms else [[] for _ in named]
    for names, layers in zip(named, copies, strict=True):
        expected = [name for name, _ in layers]
        for name in names:
            if expected[:1] == [name]:
                del expected[0]
            else:
                _check_neutral(name)
    return copies


@contextlib.contextmanager
def _no_twin_errors(env: VecEnv) -> Iterator[None]:
    try:
        yield
    except (AttributeError, NotImplementedError, EOFError, ConnectionError) as error:
        raise NoTwinError(
            f"{type(env).__name__} does not reveal how its environments were made ({error!r}). "
            "Pass twin=."
        ) from error


def _wrapper_names(text: str) -> list[str]:
    """:return: class names of the wrappers in ``str(env)``, outermost first"""
    enclosing = _ENCLOSING.findall(text)
    return enclosing if _WITHOUT_ID.search(text) else enclosing[:-1]


def _twin_of_spec(spec: EnvSpec | None) -> Twin:
    """Make the bare environment in this process to read its parameters."""
    if spec is None:
        raise NoTwinError(
            "The environments in other processes were not made by gymnasium.make, so their "
            "parameters cannot be read. Register the environment with gymnasium, or pass twin=."
        )
    registry.get(spec.id)
    arguments = {name: value for name, value in spec.kwargs.items() if name != "render_mode"}
    bare = dataclasses.replace(
        spec, kwargs=arguments, additional_wrappers=(), max_episode_steps=None, order_enforce=False
    )
    env = gymnasium.make(bare, disable_env_checker=True)
    try:
        return _twin_of_one(env)
    finally:
        env.close()


def _common_twin(copies: Sequence[Twin]) -> Twin:
    """
    :return: the twin of all copies
    :raises EnvironmentMismatchError: if they differ
    """
    first = copies[0]
    for i, other in enumerate(copies[1:], 1):
        differences = [f"{first!r} and {other!r}"]
        if other == first:
            differences = [
                f"{name} is {value:g} and {other.values[name]:g} {first.parameters[name].unit}"
                for name, value in first.values.items()
                if other.values[name] != value
            ]
        if differences:
            raise EnvironmentMismatchError(
                f"The copies 0 and {i} of the vectorised environment differ: "
                f"{', '.join(differences)}. One twin cannot mirror both: make all copies with the "
                "same arguments, or pass twin=."
            )
    return first


def _check_neutral(name: str, origin: str | None = None) -> None:
    """
    :param origin: module or entry point of the wrapper; None where only its name is known
    :raises EnvironmentMismatchError: for a wrapper not known to be neutral
    """
    package = origin.split(".")[0].split(":")[0] if origin is not None else _NEUTRAL.get(name)
    if package is None or _NEUTRAL.get(name) != package:
        raise _not_neutral_error(name, "wrapper")


def _not_neutral_error(name: str, kind: str) -> EnvironmentMismatchError:
    return EnvironmentMismatchError(
        f"The {kind} {name} may change observations, actions or rewards, so no registered twin "
        "mirrors the environment as wrapped. Remove it, or pass a twin= that simulates the wrapped "
        "environment: a TransformedTwin, or the plain twin if the wrapper changes nothing."
    )
