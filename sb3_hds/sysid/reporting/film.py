"""A machine's motion as a film; matplotlib is imported only when one is drawn."""

import os
import secrets
from pathlib import Path

import numpy as np

from sb3_hds.core.trajectories.storage import check_target
from sb3_hds.errors import ParameterError
from sb3_hds.sysid.reporting.animation import PLAYERS, Animation

_INSTALL = "A film needs imageio-ffmpeg and matplotlib: pip install imageio-ffmpeg matplotlib."
_FRAMES_PER_SECOND = 25


def check_film(path: str | os.PathLike[str]) -> None:
    """
    :raises ParameterError: for a file name that does not end in ``.mp4``
    :raises OSError: if there is no folder to write it in
    :raises ImportError: without imageio-ffmpeg and matplotlib
    """
    from importlib.util import find_spec

    if Path(path).suffix.lower() != ".mp4":
        raise ParameterError(
            f"A film is an MP4 file: name it {Path(path).with_suffix('.mp4')} in place of {path}."
        )
    check_target(path)
    if not all(map(find_spec, ("imageio_ffmpeg", "matplotlib"))):
        raise ImportError(_INSTALL)


def write_film(moving: Animation, path: str | os.PathLike[str]) -> Path:
    """
    Write the motion in real time, 25 frames a second, with the joints' errors beside it.

    :param path: ends in ``.mp4``; an existing file of that name is replaced
    """
    check_film(path)
    target = Path(path)
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(8)}.mp4")
    try:
        _draw(moving, temporary)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
    return target


def _draw(moving: Animation, path: Path) -> None:
    """Encode 1,280 x 720 pixels: the machine on the left, errors of its joints on the right."""
    import imageio_ffmpeg
    from matplotlib import rc_context
    from matplotlib.animation import FFMpegWriter
    from matplotlib.figure import Figure
    from matplotlib.patches import Polygon

    n = len(moving.names)
    figure = Figure(figsize=(12.8, 7.2), dpi=100)
    grid = figure.add_gridspec(max(n, 1), 2, width_ratios=(3, 2), left=0.02, right=0.98)
    stage = figure.add_subplot(grid[:, 0])
    stage.set(xlim=(0, 100), ylim=(100, 0), aspect="equal")
    stage.axis("off")
    drawn, shapes = [], []
    for p, player in enumerate(PLAYERS):
        patches = [Polygon(corners, closed=True) for corners in moving.outlines[p, 0]]
        for patch in patches:
            patch.set(facecolor=(player.colour, 0.25), edgecolor=player.colour, lw=0.8)
            stage.add_patch(patch)
        shapes.append(patches)
        style = {"color": player.colour, "solid_capstyle": "round", "alpha": 0.9}
        width = 3.5 * moving.width * player.width
        lines = [stage.plot([], [], lw=width, **style)[0] for _ in moving.lines[p, 0]]
        lines[0].set_label(player.label)
        drawn.append(lines)
    legend = stage.legend(loc="lower left", frameon=False)
    for handle in legend.get_lines():
        handle.set_linewidth(6.0)
    cursors = []
    for j, name in enumerate(moving.names):
        axes = figure.add_subplot(grid[j, 1])
        for values, player in zip(moving.errors, PLAYERS[1:], strict=True):
            axes.plot(moving.time, values[:, j], color=player.colour, lw=1)
        axes.set_ylabel(name, rotation=0, ha="right", fontsize=7)
        axes.tick_params(labelsize=6, labelbottom=j == n - 1)
        cursors.append(axes.axvline(0.0, color="#2b2a27", lw=0.8))
    times = np.arange(0.0, moving.time[-1] + 1e-9, 1.0 / _FRAMES_PER_SECOND)
    frames = np.minimum(np.searchsorted(moving.time, times), len(moving.time) - 1)
    writer = FFMpegWriter(fps=_FRAMES_PER_SECOND)
    with (
        rc_context({"animation.ffmpeg_path": imageio_ffmpeg.get_ffmpeg_exe()}),
        writer.saving(figure, str(path), dpi=100),
    ):
        for frame in frames.tolist():
            for lines, places in zip(drawn, moving.lines[:, frame], strict=True):
                for line, ends in zip(lines, places, strict=True):
                    line.set_data(ends[:, 0], ends[:, 1])
            for patches, places in zip(shapes, moving.outlines[:, frame], strict=True):
                for patch, corners in zip(patches, places, strict=True):
                    patch.set_xy(corners)
            for cursor in cursors:
                cursor.set_xdata([moving.time[frame]] * 2)
            writer.grab_frame()
