"""A machine that moves, as a part of a page and as a film."""

import os
import secrets
from pathlib import Path

import numpy as np

from sb3_hds.core.trajectories.storage import check_target
from sb3_hds.errors import ParameterError
from sb3_hds.sysid.reporting import figures as plots
from sb3_hds.sysid.reporting.moving import PLAYERS, Moving

_INSTALL = "A film needs imageio-ffmpeg and matplotlib: pip install imageio-ffmpeg matplotlib."
_PER_SECOND = 25  # frames of a film

STYLE = """
.moving { display: grid; grid-template-columns: minmax(0, 3fr) minmax(0, 2fr); gap: 1rem; }
.moving svg { display: block; width: 100%; height: auto; }
.moving .stage { background: #f6f7f9; }
.moving line { stroke-linecap: round; }
.errors { display: grid; grid-template-columns: repeat(auto-fill, minmax(8.5rem, 1fr));
  gap: .3rem .8rem; align-content: start; font-size: .8rem; }
.controls { display: flex; gap: .8rem; align-items: center; margin: .5rem 0; }
.controls[hidden] { display: none; }
.controls input { flex: 1; min-width: 0; }
.controls button { font: inherit; padding: .3rem .9rem; min-width: 5rem; }
.key span { display: inline-block; width: .8rem; height: .8rem; border-radius: .4rem;
  margin: 0 .3rem 0 .9rem; vertical-align: -.05rem; print-color-adjust: exact; }
@media screen and (max-width: 40rem) { .moving { grid-template-columns: minmax(0, 1fr); } }
"""

SCRIPT = """
(function () {
  const data = JSON.parse(document.getElementById("motion").textContent);
  const groups = document.querySelectorAll(".stage g"), n = data.time.length;
  const cursors = document.querySelectorAll(".errors .cursor");
  const slider = document.getElementById("frame"), button = document.getElementById("play");
  const clock = document.getElementById("clock");
  document.querySelector(".controls").hidden = false;
  slider.max = n - 1;
  let now = data.still, since = null;
  function show(frame) {
    now = frame;
    groups.forEach(function (group, player) {
      const ends = data.lines[player][frame], shapes = data.outlines[player][frame];
      group.querySelectorAll("polygon").forEach(function (outline, i) {
        outline.setAttribute("points", shapes[i].join(" "));
      });
      group.querySelectorAll("line").forEach(function (line, i) {
        ["x1", "y1", "x2", "y2"].forEach(function (name, k) {
          line.setAttribute(name, ends[4 * i + k]);
        });
      });
    });
    const share = 100 * data.time[frame] / (data.time[n - 1] || 1);
    cursors.forEach(function (line) { line.setAttribute("x1", share);
      line.setAttribute("x2", share); });
    slider.value = frame;
    clock.textContent = data.time[frame].toFixed(2) + " s";
  }
  function advance(stamp) {
    if (since === null) { return; }
    const time = (stamp - since) / 1000;
    let frame = now;
    while (frame < n - 1 && data.time[frame] < time) { frame += 1; }
    show(frame);
    if (frame < n - 1) { requestAnimationFrame(advance); } else { stop(); }
  }
  function stop() { since = null; button.textContent = "Play"; }
  button.addEventListener("click", function () {
    if (since !== null) { stop(); return; }
    if (now >= n - 1) { show(0); }
    button.textContent = "Pause";
    requestAnimationFrame(function (stamp) {
      since = stamp - 1000 * data.time[now];
      advance(stamp);
    });
  });
  slider.addEventListener("input", function () { stop(); show(Number(slider.value)); });
  show(now);
})();
"""


def section_of(moving: Moving) -> str:
    """:return: HTML that needs :data:`STYLE`; where scripts are off, one telling frame"""
    key = "".join(f'<span style="background:{colour}"></span>{name}' for name, colour in PLAYERS)
    time = moving.time[moving.still]
    return f"""<section><h2>See it move</h2>
<p class="quiet">Held-out stretches: as they were measured, and as both models predict them from the
same starts, window by window. The picture is that of {time:.2f} s, where the predictions are
farthest apart.</p>
<p class="key">{key}</p>
<div class="controls" hidden><button id="play" type="button">Play</button>
<input id="frame" type="range" min="0" value="{moving.still}" aria-label="time">
<span id="clock">{time:.2f} s</span></div>
<div class="moving"><svg class="stage" viewBox="0 0 100 100" role="img"
aria-label="the machine at {time:.2f} s">{_stage(moving)}</svg>
<div class="errors">{"".join(_chart(moving, j) for j in range(len(moving.names)))}</div></div>
<p class="quiet">Beside it: predicted minus measured position of each joint, of the model as it came
and of the corrected one.</p>
<script type="application/json" id="motion">{moving.to_json()}</script>
<script>{SCRIPT}</script></section>"""


def _stage(moving: Moving) -> str:
    groups = []
    for player, (_, colour) in enumerate(PLAYERS):
        width = moving.width * (1.6, 1.0, 0.6)[player]
        lines = "".join(
            '<line x1="{:.1f}" y1="{:.1f}" x2="{:.1f}" y2="{:.1f}"/>'.format(*ends.ravel())
            for ends in np.nan_to_num(moving.lines[player, moving.still])
        )
        shapes = "".join(
            f'<polygon points="{" ".join(f"{x:.1f}" for x in corners.ravel())}" fill="{colour}" '
            'fill-opacity=".25" stroke-width=".4"/>'
            for corners in np.nan_to_num(moving.outlines[player, moving.still])
        )
        opacity = (1.0, 0.8, 0.9)[player]
        groups.append(
            f'<g stroke="{colour}" stroke-width="{width:.2f}" stroke-opacity="{opacity}">'
            f"{shapes}{lines}</g>"
        )
    return "".join(groups)


def _chart(moving: Moving, joint: int) -> str:
    """Errors against time; both predictions on one scale, told beside the name."""
    errors = moving.errors[:, :, joint]
    finite = np.abs(errors[np.isfinite(errors)])
    most = float(np.quantile(finite, 0.98)) if len(finite) else 0.0
    scale = most or 1.0
    share = 100.0 * moving.time / (moving.time[-1] or 1.0)
    paths = []
    for values, (_, colour) in zip(errors, PLAYERS[1:], strict=True):
        y = 16.0 - 14.0 * np.clip(np.nan_to_num(values) / scale, -1.1, 1.1)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(share, y, strict=True))
        paths.append(
            f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1" '
            'vector-effect="non-scaling-stroke"/>'
        )
    at = share[moving.still]
    name, _, unit = moving.names[joint].partition(" [")
    return (
        f"<div>{name.replace('_', '_<wbr>')}<br>&plusmn;{most:.2g} {unit.rstrip(']')}"
        f'<svg viewBox="0 0 100 32" preserveAspectRatio="none" role="img" aria-label="errors of '
        f'{name}"><line x1="0" x2="100" y1="16" y2="16" stroke="#dcd9d0" stroke-width=".6"/>'
        f'{"".join(paths)}<line class="cursor" x1="{at:.1f}" x2="{at:.1f}" y1="0" y2="32" '
        'stroke="#2b2a27" stroke-width=".6"/></svg></div>'
    )


def check_film(path: str | os.PathLike[str]) -> None:
    """
    :raises ParameterError: for a name that is none of a film
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


def write_film(moving: Moving, path: str | os.PathLike[str]) -> Path:
    """
    Write the motion in real time, 25 frames a second, with the joints' errors beside it.

    :param path: ends in ``.mp4``; a file of that name is replaced as a whole
    """
    check_film(path)
    import imageio_ffmpeg

    target, encoder = Path(path), imageio_ffmpeg.get_ffmpeg_exe()
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(8)}.mp4")
    try:
        plots.draw_film(moving, PLAYERS, _at_pace(moving), temporary, _PER_SECOND, encoder)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
    return target


def _at_pace(moving: Moving) -> np.ndarray:
    """Which frame is shown when."""
    times = np.arange(0.0, moving.time[-1] + 1e-9, 1.0 / _PER_SECOND)
    return np.minimum(np.searchsorted(moving.time, times), len(moving.time) - 1)
