"""The exported page in a headless Chromium: opening it, waiting for it, and touching it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler
from typing import Any

import numpy as np
from chromium import CHROMIUM, browser
from numpy.typing import NDArray

SECONDS = 180.0
"""Shaders compile in software."""
SIZE = (160, 120)

WEBGL = ["--disable-features=WebGPU"]
"""Flags for a browser without WebGPU."""
TICKING = """
const dot = document.createElement('div');
dot.style = 'position: absolute; width: 1px; height: 1px';
document.body.append(dot);
let odd = 0;
setInterval(() => { dot.style.background = (odd ^= 1) ? 'red' : 'blue'; }, 30);
"""
"""A pixel in the corner that changes: headless Chromium takes screenshots only of frames that differ from the last."""


STOP = "document.getElementById('stop').textContent"
SAID = "document.getElementById('said').textContent"


@contextmanager
def opened(
    address: str, *, state: str = "ready", flags: Any = browser.WEBGPU, size: tuple[int, int] = SIZE, before: str = ""
) -> Iterator[Any]:
    """The page of an address, once it has a state; ``before`` is a script that runs before those of the page."""
    with browser.Browser(CHROMIUM, *size, flags) as page:
        page.call("Page.addScriptToEvaluateOnNewDocument", {"source": before})
        page.open(address)
        found = "window.sundae && window.sundae.state !== 'loading'"
        browser.wait_for(lambda: bool(page.evaluate(found)), "the page", SECONDS)
        assert page.evaluate("sundae.state") == state, page.evaluate("sundae.message")
        yield page
        assert page.errors == []


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        pass


def rested(page: Any) -> NDArray[np.int64]:
    """The canvas once it rests, without what lies over it."""
    browser.wait_for(lambda: page.evaluate("sundae.still"), "the image of a camera at rest", SECONDS)
    over = "'panel', 'message', 'status'"
    page.evaluate(f"for (const id of [{over}]) document.getElementById(id).style.visibility = 'hidden'")
    page.evaluate(f"if (!window.dot) {{ window.dot = 1; {TICKING} }}")
    shots = [page.screenshot().astype(int)]
    while len(shots) < 2 or np.abs(shots[-1] - shots[-2]).any():
        assert len(shots) < 20, "the canvas does not rest"
        shots.append(page.screenshot().astype(int))
        shots[-1][0, 0] = 0
    return shots[-1]


def touch(page: Any, at: tuple[int, int], to: tuple[int, int]) -> None:
    """Drag one finger."""
    page.call("Emulation.setTouchEmulationEnabled", {"enabled": True})
    points = [tuple(a + (b - a) * i / 4 for a, b in zip(at, to, strict=True)) for i in range(5)]
    for i, (x, y) in enumerate(points):
        event = {"type": "touchMove" if i else "touchStart", "touchPoints": [{"x": x, "y": y}]}
        page.call("Input.dispatchTouchEvent", event)
    page.call("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})


def hold(page: Any, code: str) -> None:
    """Hold a key for two frames."""
    before = page.evaluate("sundae.frames")
    page.call("Input.dispatchKeyEvent", {"type": "keyDown", "key": code, "code": code})
    browser.wait_for(lambda: page.evaluate("sundae.frames") > before + 1, "two frames", SECONDS)
    page.call("Input.dispatchKeyEvent", {"type": "keyUp", "key": code, "code": code})
