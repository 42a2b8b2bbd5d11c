"""A machine that moves on a page and in a film: its poses, and a real browser that plays it."""

import mujoco
import numpy as np
import pytest
import small_robots as robots
from browser import in_chromium, needs_chromium

from sb3_hds import twins
from sb3_hds.core import State
from sb3_hds.errors import ParameterError
from sb3_hds.sysid.reporting.animation import animate
from sb3_hds.sysid.reporting.film import check_film, write_film
from sb3_hds.sysid.reporting.page import template
from sb3_hds.sysid.reporting.pictures import replay_of


def replayed(twin, n=2, rows=30):
    """Windows of a smooth motion, and predictions that leave it, one of them faster."""
    t = np.arange(n * rows).reshape(n, rows, 1) * 0.02
    phase = np.arange(len(twin.channels))
    measured = 0.5 * np.sin(2.0 * t + phase)
    ahead = np.linspace(0.0, 1.0, rows)[None, :, None] * np.ones_like(measured)
    return replay_of(measured, 0.6 * ahead, 0.05 * ahead, np.ones(measured.shape[1:]), 0.02)


@pytest.fixture(scope="module")
def moving():
    twin = twins.from_mujoco(robots.chain(3))
    return animate(twin, twin, replayed(twin))


def test_capsules_end_where_the_joints_of_the_model_are():
    twin, q = twins.from_mujoco(robots.chain(3)), np.array([0.3, -0.5, 0.7])
    model = mujoco.MjModel.from_xml_string(robots.chain(3))
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)

    capsules = np.asarray(twin.skeleton(State(np.float32(q) + 0, np.zeros(3, np.float32), {})))

    np.testing.assert_allclose(capsules[:3, 1], data.xanchor, atol=1e-6)
    np.testing.assert_allclose(capsules[1:3, 0], data.xanchor[:2], atol=1e-6)
    np.testing.assert_allclose(capsules[3, 1], data.site_xpos[0], atol=1e-6)


def test_errors_are_those_of_the_joints_and_the_still_shows_the_largest(moving):
    assert moving.names == ("j0 [rad]", "j1 [rad]", "j2 [rad]")
    assert moving.lines.shape == (3, 60, 4, 2, 2)
    ramp = np.tile(np.linspace(0.0, 1.0, 30), 2)[:, None] * np.ones(3)
    np.testing.assert_allclose(moving.errors, [0.6 * ramp, 0.05 * ramp], atol=1e-5)
    assert moving.still in (29, 59) and moving.time[-1] == pytest.approx(59 * 0.02)
    assert moving.lines[0].min() >= 0.0 and moving.lines[0].max() <= 100.0


def test_a_film_is_written_completely_or_not_at_all(moving, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    pytest.importorskip("matplotlib")

    few = slice(0, 8)
    short = moving._replace(time=moving.time[few], lines=moving.lines[:, few])

    path = write_film(short._replace(errors=moving.errors[:, few]), tmp_path / "out.mp4")

    assert path.read_bytes()[4:8] == b"ftyp" and [p.name for p in tmp_path.iterdir()] == ["out.mp4"]
    with pytest.raises(ParameterError, match=r"name it .*out.mp4 in place of"):
        check_film(tmp_path / "out.gif")


PLAY = """(page, done) => {
  const at = id => page.getElementById(id);
  const line = () =>
    page.querySelector(".stage g:nth-child(2) line:last-child").outerHTML;
  const left = part => page.querySelector(part).getBoundingClientRect().left;
  const found = {wide: page.documentElement.scrollWidth, apart: left(".errors") - left(".stage")};
  const still = line();
  at("frame").value = 3;
  at("frame").dispatchEvent(new Event("input"));
  Object.assign(found, {moved: line() != still, clock: at("clock").textContent,
    cursor: Number(page.querySelector(".cursor").getAttribute("x1"))});
  // Nothing is painted here, so that no frame would ever be asked for.
  let stamp = 0;
  page.defaultView.requestAnimationFrame = draw => setTimeout(() => draw(stamp += 100), 1);
  at("play").click();
  const wait = setInterval(() => {
    if (at("frame").value != 59 || at("play").textContent != "Play") return;
    clearInterval(wait);
    done(found);
  }, 50);
}"""


@needs_chromium
@pytest.mark.parametrize("width", [400, 1200])
def test_a_browser_plays_it(moving, width, tmp_path):
    meta = '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    style = template("animation.css").render()
    section = template("animation.html").render(moving=moving.section())
    page = f"<!DOCTYPE html>{meta}<style>{style}</style>{section}"
    assert "http" not in page.replace("http://www.w3.org", "")

    found, console = in_chromium(page, PLAY, width, tmp_path)

    assert found["wide"] <= width and (found["apart"] > 100) == (width == 1200)
    assert found["moved"] and found["clock"] == "0.06 s"
    assert found["cursor"] == pytest.approx(5.0, abs=0.1) and console == []
