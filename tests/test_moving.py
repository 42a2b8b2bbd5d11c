"""A machine that moves on a page and in a film: its poses, and a real browser that plays it."""

import base64
import contextlib
import io
import json
import shutil
import subprocess
import time
import urllib.request

import mujoco
import numpy as np
import pytest
import small_robots as robots

from sb3_hds import twins
from sb3_hds.core import State
from sb3_hds.errors import ParameterError
from sb3_hds.sysid.film import SCRIPT, STYLE, check_film, section_of, write_film
from sb3_hds.sysid.moving import PLAYERS, moving_of
from sb3_hds.sysid.pictures import replay_of

pytestmark = pytest.mark.usefixtures("quick_compilation")


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
    return moving_of(twin, twin, replayed(twin))


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


def test_rigs_of_our_own_move_too():
    twin = twins.make("DoublePendulum")
    found = moving_of(twin, twin, replayed(twin))

    assert len(found.names) == 2 and np.ptp(found.lines[0]) > 50.0
    assert section_of(found).count("<svg") == 3


def test_a_film_is_written_as_a_whole(moving, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    pytest.importorskip("matplotlib")

    few = slice(0, 8)
    short = moving._replace(time=moving.time[few], lines=moving.lines[:, few])

    path = write_film(short._replace(errors=moving.errors[:, few]), tmp_path / "out.mp4")

    assert path.read_bytes()[4:8] == b"ftyp" and [p.name for p in tmp_path.iterdir()] == ["out.mp4"]
    with pytest.raises(ParameterError, match=r"name it .*out.mp4 in place of"):
        check_film(tmp_path / "out.gif")


class Browser:
    """As much of the DevTools protocol as a test needs."""

    def __init__(self, page, folder):
        flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0"]
        home = folder / "profile"
        self.process = subprocess.Popen(
            ["chromium", *flags, f"--user-data-dir={home}", page.as_uri()],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        from websockets.sync.client import connect

        found = home / "DevToolsActivePort"
        self.wait(lambda: found.exists() and found.read_text().count("\n") >= 1)
        port = found.read_text().split()[0]
        pages = f"http://127.0.0.1:{port}/json/list"

        def listed():
            return [p for p in json.load(urllib.request.urlopen(pages)) if p["type"] == "page"]

        self.wait(listed)
        self.open = contextlib.ExitStack()
        address = listed()[0]["webSocketDebuggerUrl"]
        self.socket = self.open.enter_context(connect(address, max_size=None))
        self.count, self.events = 0, []
        for domain in ("Runtime", "Page", "Log", "Network"):
            self.call(f"{domain}.enable")

    @staticmethod
    def wait(condition, seconds=60.0):
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, "the browser did not do it in time"
            time.sleep(0.05)

    def call(self, method, **params):
        self.count += 1
        self.socket.send(json.dumps({"id": self.count, "method": method, "params": params}))
        while True:
            told = json.loads(self.socket.recv(timeout=60))
            if told.get("id") == self.count:
                return told.get("result", {})
            self.events.append(told)

    def ask(self, script):
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def sized(self, width):
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)

    def picture(self):
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])

    @property
    def complaints(self):
        bad = ("Runtime.exceptionThrown", "Log.entryAdded")
        return [event for event in self.events if event["method"] in bad]

    def close(self):
        self.open.close()
        self.process.terminate()
        self.process.wait(20)


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium")
def test_a_browser_plays_it_from_disk_without_network_or_complaint(moving, tmp_path):
    pytest.importorskip("websockets")
    page = tmp_path / "page.html"
    head = (
        '<!DOCTYPE html><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    )
    page.write_text(f"{head}<style>{STYLE}</style>{section_of(moving)}")
    browser = Browser(page, tmp_path)
    first_line = "document.querySelector('.stage g:nth-child(2) line:last-child').outerHTML"
    try:
        browser.call("Page.reload")
        browser.wait(lambda: browser.ask("document.readyState") == "complete")
        for width in (400, 1200):
            browser.sized(width)
            wide = "document.documentElement.scrollWidth"
            assert browser.ask(wide) <= width
            left = "document.querySelector('{}').getBoundingClientRect().left".format
            stage, errors = (browser.ask(left(part)) for part in (".stage", ".errors"))
            assert (errors > stage + 100) == (width == 1200)

        still, before = browser.ask(first_line), browser.picture()
        browser.ask(
            "const s = document.getElementById('frame'); s.value = 3;"
            "s.dispatchEvent(new Event('input'))"
        )
        assert browser.ask(first_line) != still and browser.picture() != before
        assert browser.ask("document.getElementById('clock').textContent") == "0.06 s"
        assert browser.ask("document.querySelector('.cursor').getAttribute('x1')").startswith("5.0")

        browser.ask("document.getElementById('play').click()")
        browser.wait(lambda: browser.ask("Number(document.getElementById('frame').value)") == 59)
        browser.wait(lambda: browser.ask("document.getElementById('play').textContent") == "Play")
        asked = [e for e in browser.events if e["method"] == "Network.requestWillBeSent"]
        assert all(e["params"]["request"]["url"].startswith("file:") for e in asked)
        assert not browser.complaints

        # Nothing runs here: a picture, and no controls that do nothing.
        quiet = tmp_path / "quiet.html"
        quiet.write_text(page.read_text().replace(SCRIPT, ""))
        browser.call("Page.navigate", url=quiet.as_uri())
        browser.wait(lambda: browser.ask("document.readyState + location.pathname.slice(-10)")
                     == "completequiet.html")  # fmt: skip
        assert all(_shows(browser.picture(), colour) for _, colour in PLAYERS)
        assert browser.ask("document.querySelector('.controls').offsetHeight") == 0
    finally:
        browser.close()


def _shows(picture, colour):
    """Whether any points are nearly of a colour."""
    from matplotlib.image import imread

    wanted = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    points = imread(io.BytesIO(picture), format="png")[..., :3]
    return bool((np.abs(points - wanted).max(-1) < 0.12).sum() > 50)
