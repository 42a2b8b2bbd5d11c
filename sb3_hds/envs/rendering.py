"""Line drawings of twins as images."""

from typing import Any, NamedTuple

import jax
import numpy as np

from sb3_hds.core import State, Twin
from sb3_hds.envs import programs

_PIXELS = 400
_DPI = 100
_N_POSES = 64
# With more points, the polyline is a curve rather than rods between joints.
_MAX_JOINTS = 12
_MARGIN = 1.15
# Size of the window of a system on a slider, which needs room to travel, relative to a fixed one.
_TRAVEL_FACTOR = 1.8
_LINE_COLOUR, _JOINT_COLOUR, _PAPER_COLOUR, _GRID_COLOUR = (
    "#27496d",
    "#d1495b",
    "#fbfaf7",
    "#dfdcd3",
)


class View(NamedTuple):
    """
    A square window on the plane, in metres.

    :param x: horizontal position of its centre
    :param y: vertical position of its centre
    :param half: half its side
    """

    x: float
    y: float
    half: float

    def following(self, points: np.ndarray) -> "View":
        """:return: this window at the same scale, moved just far enough to show ``points``"""
        room = self.half / _MARGIN
        x, y = (
            centre + max(0.0, along.max() - centre - room) + min(0.0, along.min() - centre + room)
            for centre, along in zip((self.x, self.y), points.T, strict=True)
        )
        return View(x, y, self.half)


def view_of(twin: Twin) -> View:
    """
    A window that contains the twin at its start states, with every hinge at any angle.

    :param twin: drawn with its current parameter values
    :return: the window
    """
    seeds = np.arange(_N_POSES, dtype=np.uint32)
    start: State = jax.device_get(programs.for_many(twin).draw(seeds, twin.params))
    poses = _with_hinges_turned(twin, np.array(start.q))
    low, high = _extremes(twin, start._replace(q=poses))
    extent = float((high - low).max())
    # Whether sliders move the drawing.
    shifted = _extremes(
        twin, start._replace(q=poses + 0.01 * extent * _coordinates_in(twin, "m", poses))
    )
    roams = not np.allclose((low, high), shifted, rtol=0.0, atol=1e-3 * extent)
    x, y = (low + high) / 2.0
    half = 0.5 * extent * _MARGIN * (_TRAVEL_FACTOR if roams else 1.0)
    return View(float(x), float(y), max(half, 1e-3))


class Canvas:
    """
    Draws frames with matplotlib's Agg backend; opens no window.

    :param view: the window; follows a drawing that leaves it
    """

    def __init__(self, view: View) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self._view = view
        figure = Figure(figsize=(_PIXELS / _DPI, _PIXELS / _DPI), dpi=_DPI, facecolor=_PAPER_COLOUR)
        self._agg = FigureCanvasAgg(figure)
        self._axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), facecolor=_PAPER_COLOUR)
        self._axes.set_aspect("equal")
        self._axes.grid(color=_GRID_COLOUR, linewidth=1.0)
        self._axes.tick_params(length=0, labelbottom=False, labelleft=False)
        for spine in self._axes.spines.values():
            spine.set_visible(False)
        (self._line,) = self._axes.plot(
            [], [], color=_LINE_COLOUR, linewidth=6.0, solid_capstyle="round"
        )
        (self._dots,) = self._axes.plot(
            [], [], "o", color=_JOINT_COLOUR, markersize=5.0, markeredgewidth=0.0
        )

    def draw(self, points: Any) -> np.ndarray:
        """
        :param points: the polyline of ``Twin.sketch`` [m], shape ``(points, 2)``
        :return: RGB image, uint8, shape ``(400, 400, 3)``
        """
        points = np.asarray(points, np.float64)
        view = self._view.following(points)
        self._axes.set_xlim(view.x - view.half, view.x + view.half)
        self._axes.set_ylim(view.y - view.half, view.y + view.half)
        self._line.set_data(*points.T)
        self._dots.set_data(*points.T if len(points) <= _MAX_JOINTS else ([], []))
        self._agg.draw()
        return np.array(self._agg.buffer_rgba())[..., :3].copy()


def _extremes(twin: Twin, poses: State) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates of all drawings [m]."""
    sketches = programs.for_many(twin).sketch(poses, twin.params)
    points = np.asarray(sketches, np.float64).reshape(-1, 2)
    return points.min(0), points.max(0)


def _with_hinges_turned(twin: Twin, q: np.ndarray) -> np.ndarray:
    """Turn every hinge through full circles over the poses, each at a different rate."""
    turn = 2.0 * np.pi * np.arange(len(q))[:, None] / len(q)
    return np.where(_coordinates_in(twin, "rad", q), turn * np.arange(1, q.shape[1] + 1), q)


def _coordinates_in(twin: Twin, unit: str, q: np.ndarray) -> np.ndarray:
    """Which coordinates have this unit; none if a joint has several coordinates."""
    if q.shape[1] != len(twin.joints):
        return np.zeros(q.shape[1], bool)
    return np.array([joint.unit == unit for joint in twin.joints])
