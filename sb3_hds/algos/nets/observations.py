"""Observations as networks see them: flat, numeric, optionally normalised; supported spaces."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Float

from sb3_hds.errors import EnvironmentMismatchError

_EPSILON = 1e-8


class RunningStats(NamedTuple):
    """
    Running mean and variance of the observations of the environment.

    :param count: number of observations, shape ``()``
    """

    mean: Float[Array, " obs"]
    variance: Float[Array, " obs"]
    count: Float[Array, ""]

    @classmethod
    def empty(cls, n_obs: int) -> "RunningStats":
        return cls(jnp.zeros(n_obs), jnp.ones(n_obs), jnp.zeros(()))

    def with_more(self, obs: np.ndarray) -> "RunningStats":
        """
        :param obs: shape ``(n, obs)``
        :return: statistics with these observations included (Chan et al. 1983), on the host
        """
        n, n_more = float(self.count), len(obs)
        mean, variance = np.asarray(self.mean, np.float64), np.asarray(self.variance, np.float64)
        more, total = obs.mean(0, np.float64), n + n_more
        away = more - mean
        squares = n * variance + obs.var(0, np.float64) * n_more + away**2 * n * n_more / total
        parts = (mean + away * n_more / total, squares / total, np.asarray(total))
        return RunningStats(*(part.astype(np.float32) for part in parts))  # type: ignore[arg-type]


def normalize(stats: RunningStats, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch obs"]:
    """
    :return: standardised observations; unchanged before two were counted, so always in a policy
        that does not normalise and counts none
    """
    known = stats.count > 1.0
    std = jnp.sqrt(jnp.where(known, stats.variance, 1.0) + _EPSILON)
    return (obs - jnp.where(known, stats.mean, 0.0)) / std


def check_observations(space: spaces.Space) -> None:
    """
    :raises EnvironmentMismatchError: for images, empty observations, and spaces other than Box,
        Discrete, MultiDiscrete, MultiBinary and Dict of these
    """
    parts = space.spaces.items() if isinstance(space, spaces.Dict) else [("", space)]
    for name, part in parts:
        what = f"Observation '{name}'" if name else "The observation"
        if isinstance(part, spaces.Box) and (len(part.shape) > 2 or _is_gray_image(part)):
            raise EnvironmentMismatchError(
                f"{what} is an image, or has as many axes ({part}), and the networks here have no "
                "convolutions. Use SBX's or SB3's CnnPolicy, or observe features of it; what is no "
                "image is a vector with gymnasium.wrappers.FlattenObservation."
            )
        if not isinstance(
            part, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary
        ):
            raise EnvironmentMismatchError(
                f"{what} is a {type(part).__name__}. The networks here take Box, Discrete, "
                "MultiDiscrete, MultiBinary, and Dict of these: "
                "gymnasium.wrappers.FlattenObservation makes one of most others."
            )
        if name and isinstance(part, spaces.Box) and part.shape == ():
            raise EnvironmentMismatchError(
                f"{what} is a number without an axis ({part}), and SB3's replay buffers need one: "
                "give it the shape (1,)."
            )
        if isinstance(part, spaces.MultiDiscrete) and len(part.shape) != 1:
            raise EnvironmentMismatchError(
                f"{what} is a MultiDiscrete with {len(part.shape)} axes, and SB3's replay buffers "
                "take one: gymnasium.wrappers.FlattenObservation makes numbers of it."
            )
    if spaces.flatdim(space) == 0:
        raise EnvironmentMismatchError(f"The observation has no numbers ({space}).")


def check_actions(space: spaces.Box) -> None:
    """
    :param space: with finite limits
    :raises EnvironmentMismatchError: for integers, to which SB3's replay buffers would round
        actions scaled to [-1, 1], and for actions without a range
    """
    if not np.issubdtype(space.dtype, np.floating):
        raise EnvironmentMismatchError(
            f"Actions are whole numbers here ({space}), and the algorithms act by real ones. Use "
            "an environment whose actions are a Box of floats, and round them inside it."
        )
    if not (space.low < space.high).all():
        raise EnvironmentMismatchError(
            f"Some of the actions have no range ({space}): low must be below high. Leave them out "
            "of the action space."
        )


def _is_gray_image(space: spaces.Box) -> bool:
    """Whether it is an image without the axis of channels that SB3 expects."""
    of_bytes = space.dtype == np.uint8 and bool((space.low == 0).all() & (space.high == 255).all())
    return len(space.shape) == 2 and of_bytes


def flattener(space: spaces.Space) -> Callable[[Any], np.ndarray]:
    """
    :return: function that maps observations with a leading axis, as environments and replay buffers
        return them, to ``float32`` of shape ``(n, flatdim(space))``; choices become one-hot
    """
    if isinstance(space, spaces.Dict):
        parts = {name: flattener(part) for name, part in space.spaces.items()}
        return lambda obs: np.concatenate([flat(obs[name]) for name, flat in parts.items()], 1)  # type: ignore[call-overload]
    if isinstance(space, spaces.Discrete):
        return lambda obs: _one_hot(
            np.asarray(obs).reshape(-1, 1), np.array([space.n]), space.start
        )
    if isinstance(space, spaces.MultiDiscrete):
        n = space.nvec.ravel()
        return lambda obs: _one_hot(np.asarray(obs).reshape(-1, len(n)), n, space.start.ravel())
    return lambda obs: np.asarray(obs, np.float32).reshape(len(obs), -1)


def _one_hot(obs: np.ndarray, n: np.ndarray, start: np.ndarray) -> np.ndarray:
    choices = np.asarray(obs).reshape(-1, len(n)).astype(np.int64) - start
    if ((choices < 0) | (choices >= n)).any():
        raise ValueError(
            f"An observation is none of the choices that its space has: got {np.asarray(obs)}, "
            f"and choices go from {start} to {start + n - 1}."
        )
    flat = np.zeros((len(choices), int(n.sum())), np.float32)
    first = np.concatenate([[0], np.cumsum(n)[:-1]])
    flat[np.arange(len(choices))[:, None], choices + first] = 1.0
    return flat
