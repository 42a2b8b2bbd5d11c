"""What goes into an exported policy: observations by name, with what is known of them."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from sb3_hds.deploy.conversion import Port
from sb3_hds.deploy.normalization import WHOLE, Normalization
from sb3_hds.errors import ExportError

# Where an entry of an observation has no limits, or wider ones: it is drawn from a Gaussian.
_WIDEST = 1e3
OBSERVATION = "observation"


def parts_of(space: spaces.Space) -> dict[str, spaces.Space]:
    """:return: the parts of a dictionary; anything else under :data:`WHOLE`"""
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {WHOLE: space}


def observation_ports(space: spaces.Space, double: bool) -> dict[str, Port]:
    """
    :param double: whether numbers are in double precision
    :return: an input for each part of an observation
    :raises ExportError: for a space that no policy here has
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
    :param observed: by key, as in the space, with a leading axis
    :return: as networks see them, shape ``(batch, obs)``: choices one-hot
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
    """:return: as ``VecNormalize`` hands observations on, of NumPy or JAX"""
    if by is None:
        return values
    mean, scale = (np.asarray(part, values.dtype) for part in (by.mean, by.scale))
    return ((values - mean) / scale).clip(-by.clip, by.clip)


def drawn(
    space: spaces.Space,
    n: int,
    scales: Mapping[str, tuple[np.ndarray, np.ndarray]],
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """
    Observations to compare a file and its policy on.

    :param scales: means and standard deviations of parts, where they are known
    :return: by key, each with ``n`` rows, in single precision where they are numbers
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
