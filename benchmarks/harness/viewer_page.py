"""nerfstudio's viewer: its commands as servers, and its page, used with mouse and keyboard."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.chromium import Browser, BrowserError, wait_for

# Helpers of JavaScript. The element of a control of viser has the id that its label is for.
CONTROL = """
const control = name => {
  const label = [...document.querySelectorAll('label')].find(e => e.innerText.trim() === name && e.offsetParent);
  return label && document.getElementById(label.htmlFor);
};
const middle = e => {
  if (!e) return null;
  e.scrollIntoView({block: 'center'});
  const r = e.getBoundingClientRect();
  return r.width ? [r.x + r.width / 2, r.y + r.height / 2, r.width, r.height] : null;
};
"""
OPTIONS = "[...document.querySelectorAll('[role=option]')].filter(e => e.getBoundingClientRect().height)"
_AFTER_FRAMES = "requestAnimationFrame(() => requestAnimationFrame(() => requestAnimationFrame(done)))"
SLOW = 30.0
"""Seconds that a page has to react."""


class ViewerPage(Browser):
    """nerfstudio's viewer in a page, used through its controls with mouse and keyboard."""

    seen: NDArray[np.uint8]
    """Screenshot of the page when it last came to rest ``[H, W, 3]``."""

    def _script(self, body: str) -> Any:
        return self.evaluate(f"(() => {{ {CONTROL} return {body}; }})()")

    def _place(self, body: str, what: str) -> tuple[float, float, float, float]:
        """Middle and size of an element, once it has stopped moving."""
        found: list[Any] = [None, None]

        def still() -> bool:
            found[:] = [found[1], self._script(f"middle({body})")]
            return found[1] is not None and found[0] == found[1]

        wait_for(still, what, SLOW)
        x, y, width, height = found[1]
        return x, y, width, height

    def press(self, text: str) -> None:
        """Click on a button."""
        found = f"[...document.querySelectorAll('button')].find(e => e.innerText.trim() === {json.dumps(text)})"
        x, y, _, _ = self._place(found, f"the button {text!r}")
        self.click(x, y)

    def _unfold(self, name: str) -> None:
        x, y, _, _ = self._place(f"control({json.dumps(name)})", f"the menu {name!r}")
        self.click(x, y)
        wait_for(lambda: self.evaluate(f"{OPTIONS}.length > 0"), f"the options of {name!r}", SLOW)

    def options(self, name: str) -> list[str]:
        """Options of a menu."""
        self._unfold(name)
        found = self.evaluate(f"{OPTIONS}.map(e => e.innerText.trim())")
        self.key("Escape", 27)
        wait_for(lambda: self.evaluate(f"{OPTIONS}.length === 0"), f"{name!r} to close", SLOW)
        return [str(text) for text in found]

    def choose(self, name: str, option: str) -> None:
        """Take an option of a menu."""
        self._unfold(name)
        x, y, _, _ = self._place(f"{OPTIONS}.find(e => e.innerText.trim() === {json.dumps(option)})", f"{option!r}")
        self.click(x, y)
        value = f"control({json.dumps(name)}).value"
        wait_for(lambda: self._script(value) == option, f"{name!r} to be {option!r}", SLOW)

    def tick(self, name: str, on: bool) -> None:
        """Switch a check box."""
        box = f"control({json.dumps(name)})"
        x, y, _, _ = self._place(box, f"the box {name!r}")
        if self._script(f"{box}.checked") != on:
            self.click(x, y)
        wait_for(lambda: self._script(f"{box}.checked") == on, f"{name!r} to be {on}", SLOW)

    def slide(self, name: str, share: float) -> float:
        """Drag a slider to a share of its length; the value that it then has."""
        slider = f"control({json.dumps(name)})"
        x, y, _, _ = self._place(f"{slider}.querySelector('[role=slider]')", f"the slider {name!r}")
        middle, _, width, _ = self._place(f"{slider}.querySelector('[class*=trackContainer]')", f"the slider {name!r}")
        self.drag(x, y, middle + (share - 0.5) * width, y)
        return float(self._script(f"{slider}.querySelector('[role=slider]').getAttribute('aria-valuenow')"))

    def canvas(self) -> tuple[int, int, int, int]:
        """Left, top, width and height of the scene in a screenshot."""
        box = "[r.x, r.y, r.width, r.height].map(Math.round)"
        canvas = "document.querySelector('canvas').parentElement.getBoundingClientRect()"
        left, top, width, height = self.evaluate(f"(r => {box})({canvas})")
        return left, top, width, height

    def settle(self, act: Callable[[], Any] | None = None, longest: int = 512) -> Any:
        """Call ``act`` and wait for the viewer's image at full size, ``longest``; the result of ``act``.

        The viewer answers with a small image first, and with a full one if nothing more happens. A fast machine draws
        the first at full size; a single full image may also have been on its way before the act.
        """
        start = len(self.images)
        result = None if act is None else act()
        latest = [start, time.monotonic()]

        def done() -> bool:
            sizes = [max(size) for size in self.images[start:]]
            if start + len(sizes) != latest[0]:
                latest[:] = [start + len(sizes), time.monotonic()]
            if not sizes or sizes[-1] != longest:
                return False
            return min(sizes) < longest or time.monotonic() - latest[1] > (2 if len(sizes) > 1 else 6)

        wait_for(done, "an image of full size", 2 * SLOW)
        width, height = self.images[-1]
        resolution = f"document.body.innerText.includes('Resolution: {width}x{height}px')"
        wait_for(lambda: bool(self.evaluate(resolution)), "the page to show it", SLOW)
        self.seen = self.still()
        return result

    def rest(self, seconds: float = 1.5) -> None:
        """Wait until camera and image rest for some time; a page glides on after a drag."""
        state: list[Any] = [None, 0.0]

        def resting() -> bool:
            now = (self.camera, len(self.images))
            if now != state[0]:
                state[:] = [now, time.monotonic()]
            return time.monotonic() - float(state[1]) > seconds

        wait_for(resting, "the camera to rest", SLOW)
        self.seen = self.still()

    def still(self) -> NDArray[np.uint8]:
        """A screenshot that the next one, some frames later, agrees with."""
        last = self.screenshot()
        for _ in range(20):
            self.evaluate(f"new Promise(done => {_AFTER_FRAMES})")
            last, before = self.screenshot(), last
            if np.array_equal(last, before):
                return last
        raise BrowserError("the page does not stop changing")


class Server:
    """A command of nerfstudio's with its viewer on this machine's loopback, in a process of its own."""

    def __init__(self, command: Sequence[object], log: Path, ready: str) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]
        self.address, self._log, self._ready = f"http://127.0.0.1:{self._port}", log, ready
        name, *rest = map(str, command)
        words = [str(Path(sys.executable).parent / name), *rest]
        words += ["--viewer.websocket-host", "127.0.0.1", "--viewer.websocket-port", str(self._port)]
        environment = {**os.environ, "COLUMNS": "160"}
        with log.open("w") as file:
            streams: dict[str, Any] = {"stdout": file, "stderr": file, "stdin": subprocess.DEVNULL}
            self.process = subprocess.Popen(words, **streams, env=environment)

    def output(self) -> str:
        """Its output so far."""
        return self._log.read_text(errors="replace")

    def complaints(self) -> list[str]:
        """Words in its output that report errors."""
        return [word for word in ("Traceback", "Exception", "Error") if word in self.output()]

    def listens(self) -> bool:
        """Whether it accepts a browser."""
        if self.process.poll() is not None:
            raise BrowserError(f"it ended with {self.process.returncode}: {self.output()[-3000:]}")
        with suppress(OSError), socket.create_connection(("127.0.0.1", self._port), 1):
            return self._ready in self.output()
        return False

    def stop(self) -> None:
        """Terminate it; kill it after ten seconds."""
        self.process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(10)
        self.process.kill()  # does nothing to one that has ended
        self.process.wait()
