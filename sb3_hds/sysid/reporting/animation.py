"""Animation of a machine: as measured, and as predicted by the nominal and the extended model."""

import json
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core import Params, Twin
from sb3_hds.core.numerics.compilation import QUICKEST_COMPILATION
from sb3_hds.core.twin import plant_of
from sb3_hds.sysid.reporting.pictures import Replay
from sb3_hds.twins import MechanismTwin


class Player(NamedTuple):
    """
    A motion on the stage.

    :param width: of its capsules, in units of :attr:`Animation.width`
    """

    label: str
    colour: str
    width: float
    opacity: float


#: the motions that are drawn, the widest first
PLAYERS = (
    Player("measured", "#a9a59a", 1.6, 1.0),
    Player("predicted by the model as it came", "#d1495b", 1.0, 0.8),
    Player("predicted by the corrected model", "#27496d", 0.6, 0.9),
)
# Most frames of a page, and most joints whose errors it shows.
_MOST_FRAMES, _MOST_JOINTS = 400, 12
# Direction of view of a mechanism: azimuth and elevation [rad].
_AZIMUTH, _ELEVATION = 0.9, 0.35
# Corners of the outline of a mesh.
_CORNERS = 20
# Size of the drawing in its units.
_SIZE = 100.0


class Animation(NamedTuple):
    """
    :param time: since the first frame [s], shape ``(frames,)``
    :param lines: of each player, both ends of each capsule as projected, in the drawing's units,
        shape ``(3, frames, capsules, 2, 2)``; NaN where a simulation is not finite
    :param outlines: corners of the projected meshes, counter-clockwise, in the drawing's units,
        shape ``(3, frames, shapes, corners, 2)``
    :param names: of the joints, with their units
    :param errors: predicted minus measured position of each joint, before and after, shape ``(2,
        frames, joints)``
    :param width: of a capsule, in the drawing's units
    """

    time: np.ndarray
    lines: np.ndarray
    outlines: np.ndarray
    names: tuple[str, ...]
    errors: np.ndarray
    width: float

    @property
    def still(self) -> int:
        """The frame in which the two predictions differ most."""
        gap = np.abs(self.lines[1] - self.lines[2]).reshape(len(self.time), -1)
        return int(np.argmax(np.nan_to_num(gap).max(1)))

    def section(self) -> dict[str, Any]:
        """:return: what ``animation.html`` shows: a still, and all frames for its script"""
        still = self.still
        share = 100.0 * self.time / (self.time[-1] or 1.0)
        players = [
            player._asdict()
            | {
                "width": self.width * player.width,
                "lines": np.nan_to_num(lines[still]).reshape(-1, 4),
                "outlines": [np.nan_to_num(corners).ravel() for corners in outlines[still]],
            }
            for player, lines, outlines in zip(PLAYERS, self.lines, self.outlines, strict=True)
        ]
        return {
            "still": still,
            "time": f"{self.time[still]:.2f}",
            "cursor": f"{share[still]:.1f}",
            "players": players,
            "charts": [
                _chart(name, self.errors[:, :, j], share) for j, name in enumerate(self.names)
            ],
            "json": self._to_json(),
        }

    def _to_json(self) -> str:
        """All frames, rounded to visible precision."""
        plain = {
            "time": _numbers(self.time, 3),
            "lines": [[_numbers(frame, 1) for frame in player] for player in self.lines],
            "outlines": [
                [[_numbers(shape, 1) for shape in frame] for frame in player]
                for player in self.outlines
            ],
            "still": self.still,
        }
        return json.dumps(plain, allow_nan=False, separators=(",", ":"))


def _chart(label: str, errors: np.ndarray, share: np.ndarray) -> dict[str, Any]:
    """Errors of a joint against time, both predictions on one scale."""
    finite = np.abs(errors[np.isfinite(errors)])
    most = float(np.quantile(finite, 0.98)) if len(finite) else 0.0
    curves = []
    for values, player in zip(errors, PLAYERS[1:], strict=True):
        y = 16.0 - 14.0 * np.clip(np.nan_to_num(values) / (most or 1.0), -1.1, 1.1)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(share, y, strict=True))
        curves.append((player.colour, points))
    name, _, unit = label.partition(" [")
    return {"name": name, "unit": unit.rstrip("]"), "most": most, "curves": curves}


def animate(believed: Twin, extended: Twin, replay: Replay) -> Animation:
    """
    :param believed: nominal model
    :param extended: corrected model
    :param replay: held-out stretches
    """
    rows = np.flatnonzero(np.isfinite(replay.time))
    rows = rows[:: max(1, -(-len(rows) // _MOST_FRAMES))]
    seen = [np.asarray(part)[rows] for part in (replay.measured, replay.before, replay.after)]
    found = [
        tuple(map(np.asarray, _poses(twin, twin.params, jnp.asarray(obs, jnp.float32))))
        for twin, obs in zip((believed, believed, extended), seen, strict=True)
    ]
    ends, joints, meshes = (np.stack(parts) for parts in zip(*found, strict=True))
    solid = isinstance(plant_of(believed), MechanismTwin)
    seen_from = _projected(ends) if solid else ends[..., [0, 2]]
    outlines = _outlines(_projected(meshes))
    frame = _frame_of(np.concatenate([part[0].reshape(-1, 2) for part in (seen_from, outlines)]))
    names = tuple(f"{joint.name} [{joint.unit}]" for joint in believed.joints)
    capsules = ends.shape[2]
    return Animation(
        replay.time[rows] - replay.time[rows[0]],
        frame(seen_from),
        frame(outlines),
        names[:_MOST_JOINTS],
        (joints[1:] - joints[:1])[..., :_MOST_JOINTS],
        (4.0 if capsules <= 8 else 2.5) * (0.3 if meshes.size else 1.0),
    )


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _poses(
    twin: Twin, params: Params, obs: Float[Array, "frames obs"]
) -> tuple[
    Float[Array, "frames capsules 2 3"],
    Float[Array, "frames joints"],
    Float[Array, "frames shapes corners 3"],
]:
    plant = plant_of(twin)

    def one(row: Array) -> tuple[Array, Array, Array]:
        state = twin.infer(row, params)
        own = {name: params[name] for name in plant.parameters}
        if isinstance(plant, MechanismTwin):
            return plant.skeleton(state), twin.coordinates(state.q), plant.meshes(state)
        points = plant.sketch(state, own)
        flat = jnp.stack([points[:, 0], jnp.zeros_like(points[:, 0]), points[:, 1]], 1)
        bare = jnp.zeros((0, 0, 3), flat.dtype)
        return jnp.stack([flat[:-1], flat[1:]], 1), twin.coordinates(state.q), bare

    return jax.vmap(one)(obs)


def _projected(ends: np.ndarray) -> np.ndarray:
    """Parallel projection, seen from the front, the right and above."""
    c, s = np.cos(_AZIMUTH), np.sin(_AZIMUTH)
    right, away = c * ends[..., 0] + s * ends[..., 1], -s * ends[..., 0] + c * ends[..., 1]
    up = np.cos(_ELEVATION) * ends[..., 2] + np.sin(_ELEVATION) * away
    return np.stack([right, up], -1)


def _outlines(corners: np.ndarray) -> np.ndarray:
    """
    :param corners: of convex bodies as projected, shape ``(..., corners, 2)``
    :return: the farthest of them in each of ``_CORNERS`` directions
    """
    if not corners.size:
        return np.zeros((*corners.shape[:-2], 0, 2))
    angles = 2.0 * np.pi * np.arange(_CORNERS) / _CORNERS
    along = corners @ np.stack([np.cos(angles), np.sin(angles)])
    farthest = np.argmax(np.nan_to_num(along, nan=-np.inf), axis=-2)
    return np.take_along_axis(corners, farthest[..., None], axis=-2)


def _frame_of(measured: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """
    :param measured: points, shape ``(n, 2)``
    :return: maps points to the drawing's units, y downwards, with these points in its centre
    """
    real = measured[np.isfinite(measured).all(1)]
    low, high = real.min(0), real.max(0)
    scale = 0.84 * _SIZE / (float(np.max(high - low)) or 1.0)

    def framed(seen: np.ndarray) -> np.ndarray:
        flipped = (seen - 0.5 * (low + high)) * scale * [1.0, -1.0]
        return np.clip(flipped + 0.5 * _SIZE, -_SIZE, 2.0 * _SIZE)

    return framed


def _numbers(x: Any, digits: int) -> list[float]:
    rounded = np.round(np.nan_to_num(np.asarray(x, float)), digits)
    return [int(v) if v == int(v) else v for v in rounded.ravel().tolist()]
