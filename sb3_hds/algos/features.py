"""Images among observations: they pass convolutions, everything else goes on as it is."""

from typing import Any, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from gymnasium import spaces
from jaxtyping import Array, Float
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first

from sb3_hds.algos.observations import size_of
from sb3_hds.errors import EnvironmentMismatchError

# Filters, size and stride of each layer, and the smallest image that they leave something of.
_LAYERS = ((32, 8, 4), (64, 4, 2), (64, 3, 1))
_SMALLEST = 36
# Features of an image alone and among other observations, by the name that SB3 has for them.
_USUAL = {"features_dim": 512, "cnn_output_dim": 256}


class Part(NamedTuple):
    """
    Of a flat observation.

    :param size: how many numbers
    :param image: height, width and channels in the order in which they come; None: no image
    :param channels_first: whether the channels come first
    """

    size: int
    image: tuple[int, ...] | None = None
    channels_first: bool = False


def parts_of(space: spaces.Space, normalize_images: bool) -> tuple[Part, ...]:
    """
    :param normalize_images: False: every Box of three axes is an image, as in SB3
    :return: in the order of a flat observation
    :raises EnvironmentMismatchError: for an image that is too small for the convolutions
    """
    each = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    return tuple(_part(part, normalize_images) for part in each)


def _part(space: spaces.Space, normalize_images: bool) -> Part:
    if not is_image(space, normalize_images):
        return Part(size_of(space))
    shape: Any = space.shape
    first = is_image_space_channels_first(space)  # type: ignore[arg-type]
    height, width = shape[1:] if first else shape[:2]
    if min(height, width) < _SMALLEST:
        raise EnvironmentMismatchError(
            f"The observation has an image of {height} x {width} pixels, and the convolutions need "
            f"{_SMALLEST} x {_SMALLEST}: enlarge it (gymnasium.wrappers.ResizeObservation), or "
            "flatten it (gymnasium.wrappers.FlattenObservation)."
        )
    return Part(size_of(space), shape, first)


def is_image(space: spaces.Space, normalize_images: bool = True) -> bool:
    """:return: whether SB3 takes it for an image"""
    return is_image_space(space, normalized_image=not normalize_images)


def n_features(parts: tuple[Part, ...], extractor: dict[str, Any] | None) -> int:
    """
    :param extractor: SB3's ``features_extractor_kwargs``: ``features_dim`` of an image alone,
        ``cnn_output_dim`` of each image of a Dict
    :return: features of each image
    :raises ValueError: for other arguments
    """
    name = "features_dim" if len(parts) == 1 else "cnn_output_dim"
    given = extractor or {}
    fine = set(given) <= {name} and all(isinstance(n, int) and n > 0 for n in given.values())
    if not fine:
        raise ValueError(
            f"features_extractor_kwargs may hold {name}, a whole number of at least 1, with these "
            f"observations, got {extractor!r}."
        )
    return given.get(name, _USUAL[name])


class Convolutions(nn.Module):
    """
    Source: Mnih et al., *Human-level control through deep reinforcement learning*, Nature 2015.

    :param n_features: of the image
    """

    n_features: int

    @nn.compact
    def __call__(
        self, image: Float[Array, "*batch height width channels"]
    ) -> Float[Array, "*batch n"]:
        for filters, size, stride in _LAYERS:
            layer = nn.Conv(filters, (size, size), (stride, stride), padding="VALID")
            image = nn.relu(layer(image))
        return nn.relu(nn.Dense(self.n_features)(image.reshape(*image.shape[:-3], -1)))


class Looking(nn.Module):
    """
    A body that sees features of images in their place.

    :param parts: of the observation, with which its input begins
    :param n_features: of each image
    :param body: see ``bodies.py``
    """

    parts: tuple[Part, ...]
    n_features: int
    body: nn.Module

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n"], train: bool) -> Float[Array, "*batch m"]:
        ends = [sum(part.size for part in self.parts[: i + 1]) for i in range(len(self.parts))]
        *pieces, rest = jnp.split(x, ends, -1)
        seen = [self._seen(part, piece) for part, piece in zip(self.parts, pieces, strict=True)]
        return self.body(jnp.concatenate([*seen, rest], -1), train)

    def _seen(self, part: Part, piece: Array) -> Array:
        if part.image is None:
            return piece
        image = piece.reshape(*piece.shape[:-1], *part.image)
        upright = jnp.moveaxis(image, -3, -1) if part.channels_first else image
        return Convolutions(self.n_features)(upright)


def looking(parts: tuple[Part, ...], n_features: int, body: nn.Module) -> nn.Module:
    """:return: the body; where there are images, one that sees their features"""
    if all(part.image is None for part in parts):
        return body
    return Looking(parts, n_features, body)
