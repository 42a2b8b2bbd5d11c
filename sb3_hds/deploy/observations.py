"""Observations of an exported policy: named inputs, and the normalisation of ``VecNormalize``."""

import os
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from sb3_hds.errors import ExportError

# Entries of an observation with wider limits, or none, are drawn from a Gaussian.
_WIDEST = 1e3
OBSERVATION = "observation"

#: key of an observation that is not a dictionary
SINGLE = ""


class Port(NamedTuple):
    """
    An input or an output.

    :param shape: without the batch axis
    :param dtype: NumPy's name
    """

    name: str
    shape: tuple[int, ...]
    dtype: str


class Normalization(NamedTuple):
    """
    Normalisation of one observation by ``VecNormalize``: ``clip((obs - mean) / scale)``.

    :param mean: of the shape of the observation
    :param scale: of the shape of the observation
    :param clip: largest absolute value of the result
    """

    mean: np.ndarray
    scale: np.ndarray
    clip: float


def parts_of(space: spaces.Space) -> dict[str, spaces.Space]:
    """:return: the parts of a dictionary; anything else under :data:`SINGLE`"""
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {SINGLE: space}


def observation_ports(space: spaces.Space, double: bool) -> dict[str, Port]:
    """
    :param double: whether floats are in double precision
    :return: an input for each part of an observation
    :raises ExportError: for an unsupported space
    """
    ports = {}
    for key, part in parts_of(space).items():
        name = f"{OBSERVATION}.{key}" if key else OBSERVATION
        match part:
            case spaces.Box() | spaces.MultiBinary():
                ports[key] = Port(name, part.shape or (), "float64" if double else "float32")  # type: ignore[arg-type]
            case spaces.Discrete():
                ports[key] = Port(name, (), "int32")
            case spaces.MultiDiscrete():
                ports[key] = Port(name, part.shape, "int32")
            case _:
                raise ExportError(f"Observations of this kind cannot be exported: {part}.")
    return ports


def flat(space: spaces.Space, observed: Mapping[str, jax.Array]) -> jax.Array:
    """
    :param observed: by key of the space, with a leading batch axis
    :return: input of the networks, shape ``(batch, obs)``, with one-hot choices
    """
    rows = []
    for key, part in parts_of(space).items():
        values = observed[key]
        match part:
            case spaces.Discrete():
                rows.append(_one_hot(values, int(part.n), int(part.start)))
            case spaces.MultiDiscrete():
                ends = zip(part.nvec.ravel(), part.start.ravel(), strict=True)
                rows += [_one_hot(values[:, i], int(n), int(s)) for i, (n, s) in enumerate(ends)]
            case _:
                rows.append(values.reshape(-1, spaces.flatdim(part)))
    return rows[0] if len(rows) == 1 else jnp.concatenate(rows, 1)


def _one_hot(choice: jax.Array, n: int, start: int) -> jax.Array:
    return jnp.where(choice[:, None] == np.arange(start, start + n)[None], 1.0, 0.0)


def normalized(values: Any, by: Normalization | None) -> Any:
    """:return: normalised like ``VecNormalize`` does, of NumPy or JAX"""
    if by is None:
        return values
    mean, scale = (np.asarray(part, values.dtype) for part in (by.mean, by.scale))
    return ((values - mean) / scale).clip(-by.clip, by.clip)


def random_observations(
    space: spaces.Space,
    n: int,
    scales: Mapping[str, tuple[np.ndarray, np.ndarray]],
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """
    Random observations to compare a file and its policy on.

    :param scales: means and standard deviations of parts, if known
    :return: by key, each with ``n`` rows, floats in single precision
    """
    found = {}
    for key, part in parts_of(space).items():
        if not isinstance(part, spaces.Box):
            part.seed(int(rng.integers(2**31)))
            found[key] = np.stack([np.asarray(part.sample()) for _ in range(n)])
            continue
        mean, scale = scales.get(key, (np.zeros(part.shape), np.ones(part.shape)))
        values = mean + 2.0 * scale * rng.standard_normal((n, *part.shape))
        low, high = part.low.astype(float), part.high.astype(float)
        within = (np.abs(low) < _WIDEST) & (np.abs(high) < _WIDEST)
        ends = np.where(within, low, 0.0), np.where(within, high, 1.0)
        values = np.where(within, rng.uniform(*ends, size=values.shape), values)
        found[key] = values.astype(np.float32)
    return found


def normalizations(normalize: Any) -> dict[str, Normalization]:
    """
    :param normalize: a ``VecNormalize``, or None
    :return: by key of the observation, :data:`SINGLE` if it is not a dictionary; empty if
        observations are not normalised
    """
    if normalize is None or not normalize.norm_obs:
        return {}
    found = (
        normalize.obs_rms if isinstance(normalize.obs_rms, dict) else {SINGLE: normalize.obs_rms}
    )
    return {
        name: Normalization(
            np.asarray(part.mean, np.float64),
            np.sqrt(np.asarray(part.var, np.float64) + normalize.epsilon),
            float(normalize.clip_obs),
        )
        for name, part in found.items()
    }


def load_vec_normalize(path: str | os.PathLike[str]) -> Any:
    """
    Unpickles: only load files that you trust.

    :param path: ``vecnormalize.pkl`` of a training
    :raises ExportError: for a file with other content
    """
    import pickle

    from stable_baselines3.common.vec_env import VecNormalize

    with open(path, "rb") as file:
        try:
            found = pickle.load(file)
        # On damaged files, pickle may raise anything.
        except Exception as error:
            raise ExportError(f"'{path}' cannot be unpickled: {error}.") from error
    if not isinstance(found, VecNormalize):
        raise ExportError(
            f"'{path}' holds a {type(found).__name__} instead of a VecNormalize, which RL Zoo "
            "saves as vecnormalize.pkl beside a model."
        )
    return found
