"""A page as a real browser lays it out and plays it."""

import html
import json
import shutil
import subprocess
from pathlib import Path

import pytest

needs_chromium = pytest.mark.skipif(
    not shutil.which("chromium"), reason="chromium is not installed (Debian: apt install chromium)"
)
_HOST = """<!DOCTYPE html><title></title><script>addEventListener("load", () => ({look})(
  document.querySelector("iframe").contentDocument,
  found => document.title = JSON.stringify(found)));</script>
<iframe style="width:{width}px;height:900px;border:0" srcdoc="{page}"></iframe>"""


def in_chromium(page: str, look: str, width: int, folder: Path) -> tuple[dict, list[str]]:
    """A page in a frame of so many pixels, as JavaScript looks at it; and the console."""
    host = folder / f"host{width}.html"
    host.write_text(_HOST.format(look=look, width=width, page=html.escape(page)))
    words = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"]
    words += ["--window-size=1500,1000", "--virtual-time-budget=20000", "--dump-dom"]
    browser = subprocess.run(
        ["chromium", *words, host.as_uri()], capture_output=True, text=True, timeout=120
    )
    title = browser.stdout.partition("<title>")[2].partition("</title>")[0]
    console = [line for line in browser.stderr.splitlines() if "CONSOLE" in line]
    return json.loads(html.unescape(title)), console
