"""nerfstudio's viewer in a headless Chromium, while training; print one JSON line.

    python benchmarks/browser.py --seconds 300          # needs a Chromium (apt-get install chromium)

Trains with the viewer open, moves the camera and uses the controls, and watches the render thread and memory. Exits
with 1 if the viewer falls silent, a log has an error, training stands still, or the training process still grows by
more than ``--allowed`` megabytes a minute in the second half.

The driver talks Chromium's own DevTools protocol, which is JSON over a websocket; viser brings the websocket library.
So there is no further dependency whose version has to match the browser. ``tests/integration/test_browser.py`` uses the
driver too. The browser needs no display and renders WebGL in software. It resolves no host names, and reaches only this
machine's loopback.
"""

from __future__ import annotations

import argparse
import base64
import io
import itertools
import json
import os
import queue
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from ray_tracing import write_still_life
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

FLAGS = """
--headless=new --no-sandbox --no-first-run --disable-dev-shm-usage --disable-background-networking --disable-sync
--disable-component-update --disable-extensions --hide-scrollbars --mute-audio --force-device-scale-factor=1
--use-angle=swiftshader --enable-unsafe-swiftshader --remote-debugging-port=0
""".split()
ONLY_LOOPBACK = "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1"
# What viser 0.2.7 says on an empty page too: the shaders of its own splats have none to show.
KNOWN = ("THREE.BufferGeometry.computeBoundingSphere(): Computed radius is NaN",)
FOREIGN = "net::ERR_NAME_NOT_RESOLVED"
WEBGPU = """
--enable-unsafe-webgpu --use-webgpu-adapter=swiftshader --enable-features=Vulkan --use-vulkan=swiftshader
""".split()
"""Flags for WebGPU in software; without Vulkan there is no WebGPU canvas."""


def find_chromium() -> str | None:
    """The first Chromium or Chrome on the path; None if there is none."""
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    return next((path for path in map(shutil.which, names) if path), None)


Opened = TypeVar("Opened", bound="Browser")


class BrowserError(RuntimeError):
    """The browser did not react in time, or refused a call."""


@dataclass
class Camera:
    """Camera of the page, from its last message to the viewer: OpenCV axes, in the viewer's units."""

    wxyz: tuple[float, float, float, float]
    position: tuple[float, float, float]
    fov: float
    """Vertical, radian."""
    aspect: float


class Browser:
    """One page of a headless Chromium; a context manager.

    Args:
        executable: from :func:`find_chromium`.
        width: of the page, pixels.
        height: of the page, pixels.
        flags: more flags of Chromium.
    """

    def __init__(self, executable: str, width: int = 960, height: int = 640, flags: Sequence[str] = ()) -> None:
        size = f"--window-size={width},{height}"
        self._command = [executable, *FLAGS, *flags, ONLY_LOOPBACK, size, "about:blank"]
        self._size = (width, height)
        self._stack = ExitStack()
        self._answers: dict[int, queue.SimpleQueue[dict[str, Any]]] = {}
        self._lock = threading.Lock()
        self._calls = 0
        self.errors: list[str] = []
        """What the page wrote to its console as an error, and exceptions that it did not catch; without ``KNOWN``."""
        self.camera: Camera | None = None
        self.images: list[tuple[int, int]] = []
        """Width and height of every image that the viewer has sent."""

    # ------------------------------------------------------------------------------------------- life of the browser

    def __enter__(self: Opened) -> Opened:
        try:
            self._start()
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def _start(self) -> None:
        # Chromium's children write to the folder until they are gone.
        profile = Path(self._stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)))
        log = self._stack.enter_context(open(profile / "log", "w"))
        # A killed browser leaves its temporary files behind.
        process = subprocess.Popen(
            [*self._command, f"--user-data-dir={profile}"],
            stdout=log,
            stderr=log,
            start_new_session=True,
            env={**os.environ, "TMPDIR": str(profile)},
        )
        self._stack.callback(self._end, process)
        address = profile / "DevToolsActivePort"

        def ready() -> bool:
            if process.poll() is not None:
                raise BrowserError(
                    f"the browser ended with {process.returncode}: {(profile / 'log').read_text()[-500:]}"
                )
            return address.exists() and address.read_text().count("\n") == 1

        wait_for(ready, "the browser's port", 60)
        port, path = address.read_text().split("\n")
        self._socket = self._stack.enter_context(
            connect(
                f"ws://127.0.0.1:{port}{path}", max_size=None, compression=None, open_timeout=60, ping_interval=None
            )
        )
        threading.Thread(target=self._listen, daemon=True).start()
        targets = self.call("Target.getTargets", browser=True)["targetInfos"]
        page = next(target["targetId"] for target in targets if target["type"] == "page")
        self._page = self.call("Target.attachToTarget", {"targetId": page, "flatten": True}, browser=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        # The page talks to the viewer in a worker; it waits at its start until its messages are recorded.
        self.call("Target.setAutoAttach", {"autoAttach": True, "waitForDebuggerOnStart": True, "flatten": True})
        width, height = self._size
        self.call(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False},
        )

    def _end(self, process: subprocess.Popen[bytes]) -> None:
        with suppress(BrowserError, ConnectionClosed, AttributeError):
            self.call("Browser.close", browser=True, timeout=5)
        with suppress(subprocess.TimeoutExpired):
            process.wait(3)
        # Its renderers too, which take their time where WebGL is drawn in software.
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    # --------------------------------------------------------------------------------------------------- the protocol

    def call(
        self,
        method: str,
        params: dict[str, Any] | None = None,
        *,
        browser: bool = False,
        timeout: float = 60,
    ) -> dict[str, Any]:
        """One call of the protocol, to the page or to the browser itself; its result.

        Raises:
            BrowserError: the call failed, or took too long.
        """
        answer: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        number = self._send(method, params, None if browser else self._page, answer)
        try:
            message = answer.get(timeout=timeout)
        except queue.Empty as error:
            raise BrowserError(f"{method} took more than {timeout} s") from error
        finally:
            self._answers.pop(number, None)
        if "error" in message:
            raise BrowserError(f"{method}: {message['error'].get('message')}")
        return dict(message["result"])

    def _send(
        self,
        method: str,
        params: dict[str, Any] | None,
        session: str | None,
        answer: queue.SimpleQueue[dict[str, Any]] | None = None,
    ) -> int:
        with self._lock:
            self._calls += 1
            number = self._calls
            if answer is not None:
                self._answers[number] = answer
        message = {"id": number, "method": method, "params": params or {}}
        self._socket.send(json.dumps(message if session is None else {**message, "sessionId": session}))
        return number

    def _listen(self) -> None:
        with suppress(ConnectionClosed):
            for text in self._socket:
                message = json.loads(text)
                if "id" in message:
                    answer = self._answers.get(message["id"])
                    if answer is not None:
                        answer.put(message)
                else:
                    self._on_event(message["method"], message["params"])
        for answer in list(self._answers.values()):
            answer.put({"error": {"message": "the browser is gone"}})

    def _on_event(self, method: str, params: dict[str, Any]) -> None:
        if method == "Target.attachedToTarget":
            session = params["sessionId"]
            for name in ("Runtime.enable", "Network.enable", "Runtime.runIfWaitingForDebugger"):
                self._send(name, None, session)
        elif method == "Network.webSocketFrameSent":
            self._on_sent(_unpack(params["response"]))
        elif method == "Network.webSocketFrameReceived":
            self._on_received(_unpack(params["response"]))
        elif method == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description") or details["text"])
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "assert"):
            words = [str(word.get("value", word.get("description", ""))) for word in params["args"]]
            self._on_error(" ".join(words))
        elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
            entry = params["entry"]
            # Google's analytics in viser's page and nerfstudio's logo, from hosts that are out of reach here.
            if not (FOREIGN in entry["text"] and not entry.get("url", "").startswith("http://127.0.0.1")):
                self._on_error(f"{entry['text']} {entry.get('url', '')}")

    def _on_error(self, text: str) -> None:
        if not text.startswith(KNOWN):
            self.errors.append(text)

    # ------------------------------------------------------------------------------------------------ viser's messages

    def _on_sent(self, message: Any) -> None:
        for part in _messages(message):
            if part.get("type") == "ViewerCameraMessage":
                self.camera = Camera(
                    tuple(part["wxyz"]), tuple(part["position"]), float(part["fov"]), float(part["aspect"])
                )

    def _on_received(self, message: Any) -> None:
        for part in _messages(message):
            if part.get("type") == "BackgroundImageMessage":
                with Image.open(io.BytesIO(part["rgb_bytes"])) as image:
                    self.images.append(image.size)

    # ------------------------------------------------------------------------------------------------------- the page

    def open(self, address: str) -> None:
        """Go to an address."""
        found = self.call("Page.navigate", {"url": address})
        if "errorText" in found:
            raise BrowserError(f"{address}: {found['errorText']}")

    def evaluate(self, expression: str) -> Any:
        """Value of an expression of JavaScript in the page."""
        found = self.call("Runtime.evaluate", {"expression": expression, "returnByValue": True, "awaitPromise": True})
        if "exceptionDetails" in found:
            raise BrowserError(f"{expression}: {found['exceptionDetails']['text']}")
        return found["result"].get("value")

    def screenshot(self) -> NDArray[np.uint8]:
        """The page as shown ``[H, W, 3]``."""
        data = self.call("Page.captureScreenshot", {"format": "png"})["data"]
        with Image.open(io.BytesIO(base64.b64decode(data))) as image:
            return np.asarray(image.convert("RGB"))

    def mouse(self, kind: str, x: float, y: float, pressed: bool = False) -> None:
        """One event of the mouse: ``mouseMoved``, ``mousePressed`` or ``mouseReleased``, at a pixel of the page."""
        button = "left" if pressed or kind != "mouseMoved" else "none"
        event = {"type": kind, "x": x, "y": y, "button": button, "buttons": int(pressed), "clickCount": 1}
        self.call("Input.dispatchMouseEvent", event)

    def click(self, x: float, y: float) -> None:
        """Press and release the mouse at a pixel."""
        self.mouse("mouseMoved", x, y)
        self.mouse("mousePressed", x, y, pressed=True)
        self.mouse("mouseReleased", x, y)

    def drag(self, x: float, y: float, to_x: float, to_y: float, steps: int = 8, seconds: float = 0.0) -> None:
        """Press at one pixel and release at another, through ``steps`` in between."""
        self.mouse("mouseMoved", x, y)
        self.mouse("mousePressed", x, y, pressed=True)
        for i in range(1, steps + 1):
            self.mouse("mouseMoved", x + (to_x - x) * i / steps, y + (to_y - y) * i / steps, pressed=True)
            time.sleep(seconds / steps)
        self.mouse("mouseReleased", to_x, to_y)

    def key(self, name: str, code: int, text: str = "", modifiers: int = 0) -> None:
        """Press and release a key by its DOM name and its virtual key code."""
        event = {"key": name, "code": name, "windowsVirtualKeyCode": code, "modifiers": modifiers}
        self.call("Input.dispatchKeyEvent", {"type": "keyDown", **event, **({"text": text} if text else {})})
        self.call("Input.dispatchKeyEvent", {"type": "keyUp", **event})


def _unpack(response: dict[str, Any]) -> Any:
    """A message of viser's websocket; None unless the frame is binary."""
    return msgspec.msgpack.decode(base64.b64decode(response["payloadData"])) if response["opcode"] == 2 else None


def _messages(message: Any) -> list[dict[str, Any]]:
    """viser sends one message, or a batch of them in one frame."""
    if isinstance(message, dict):
        return _messages(message["messages"]) if "messages" in message else [message]
    return [part for part in message if isinstance(part, dict)] if isinstance(message, list) else []


def wait_for(ready: Callable[[], bool], what: str, seconds: float) -> None:
    """Return as soon as ``ready()``.

    Raises:
        BrowserError: not in this time.
    """
    end = time.monotonic() + seconds
    while not ready():
        if time.monotonic() > end:
            raise BrowserError(f"waited {seconds:g} s for {what}")
        time.sleep(0.05)


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
        wait_for(
            lambda: self._script(f"control({json.dumps(name)}).value") == option, f"{name!r} to be {option!r}", SLOW
        )

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
        found = self.evaluate(
            "(() => { const r = document.querySelector('canvas').parentElement.getBoundingClientRect();"
            " return [r.x, r.y, r.width, r.height].map(Math.round); })()"
        )
        left, top, width, height = found
        return left, top, width, height

    def settle(self, act: Callable[[], Any] | None = None, longest: int = 512) -> Any:
        """Call ``act`` and wait for the viewer's image at full size; the result of ``act``.

        The viewer answers with a small image first and then, if nothing more happens, with one whose longer side is
        ``longest``. An image that was on its way before the act is of full size too.
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
            # A fast machine draws the first image at full size; a single image may also have been on its way before.
            return min(sizes) < longest or time.monotonic() - latest[1] > (2 if len(sizes) > 1 else 6)

        try:
            wait_for(done, "an image of full size", 2 * SLOW)
        except BrowserError as error:
            raise BrowserError(f"{error}; images were {self.images[start:]}") from error
        width, height = self.images[-1]
        shown = f"document.body.innerText.includes('Resolution: {width}x{height}px')"
        wait_for(lambda: bool(self.evaluate(shown)), "the page to show it", SLOW)
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
    """A command of nerfstudio's with its viewer on this machine's loopback, in a process of its own.

    Args:
        command: name in the environment's folder of commands, and its arguments without those of the viewer.
        log: file for its output.
        ready: words in its output that say that it is ready.
    """

    def __init__(self, command: Sequence[object], log: Path, ready: str) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]
        self.address, self._log, self._ready = f"http://127.0.0.1:{self._port}", log, ready
        name, *rest = map(str, command)
        words = [str(Path(sys.executable).parent / name), *rest]
        words += ["--viewer.websocket-host", "127.0.0.1", "--viewer.websocket-port", str(self._port)]
        with log.open("w") as file:
            self.process = subprocess.Popen(
                words, stdout=file, stderr=file, stdin=subprocess.DEVNULL, env={**os.environ, "COLUMNS": "160"}
            )

    def output(self) -> str:
        """Its output so far."""
        return self._log.read_text(errors="replace")

    def complaints(self) -> list[str]:
        """Words in its output that report errors."""
        return [word for word in ("Traceback", "Exception", "Error") if word in self.output()]

    def listens(self) -> bool:
        """Whether it accepts a browser.

        Raises:
            BrowserError: it has ended.
        """
        if self.process.poll() is not None:
            raise BrowserError(f"it ended with {self.process.returncode}: {self.output()[-3000:]}")
        with suppress(OSError), socket.create_connection(("127.0.0.1", self._port), 1):
            return self._ready in self.output()
        return False

    def stop(self) -> None:
        """Terminate it; kill it after ten seconds."""
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


# ------------------------------------------------------------------------------------------------------------- training


PRUNE_AT = 300
STEP = re.compile(r"(\d+) \(\d+\.\d+%\)")
"""nerfstudio's table of progress."""
SLICE = 30.0
"""In every period of this many seconds images must arrive."""


def resident(pid: int) -> float:
    """Megabytes of a process in the host's memory."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def last_step(log: str) -> int:
    """Last step in the log; -1 before the first."""
    found = STEP.findall(log[-20_000:])
    return int(found[-1]) if found else -1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--allowed", type=float, default=5.0, help="megabytes a minute")
    options = parser.parse_args()
    chromium = find_chromium()
    if chromium is None:
        sys.exit("no Chromium here; apt-get install chromium")
    chance = random.Random(0)
    with tempfile.TemporaryDirectory() as folder:
        scene = write_still_life(
            Path(folder) / "scene", train_views=8, test_views=2, width=64, height=64, points=300, samples=1
        )
        words = ["ns-train", "sundae-tiny", "--data", scene, "--output-dir", Path(folder) / "out", "--vis", "viewer"]
        words += ["--max-num-iterations", 10_000_000, "--steps-per-save", 10_000_000, "--logging.steps-per-log", 10]
        words += ["--pipeline.model.pruning.prune-at", PRUNE_AT, "--pipeline.model.warmup-length", 5]
        server = Server(words, Path(folder) / "train.log", "(0.00%)")
        try:
            with ViewerPage(chromium, 640, 400) as page:
                wait_for(server.listens, "ns-train", 180)
                page.open(server.address)
                wait_for(lambda: bool(page.images), "the first image", 60)
                wait_for(lambda: last_step(server.output()) > PRUNE_AT, "the prune", 300)
                page.press("Hide Train Cams")
                outputs = page.options("Output type")
                acts = itertools.cycle(
                    [
                        *(lambda name=name: page.choose("Output type", name) for name in outputs),
                        lambda: page.choose("Output type", outputs[0]),
                        lambda: page.tick("Neural compensation", False),
                        lambda: page.slide("Keep ratio", 0.3),
                        lambda: page.slide("Keep ratio", 0.05),
                        lambda: page.slide("Keep ratio", 1.1),
                        lambda: page.tick("Neural compensation", True),
                    ]
                )
                start, first_step = time.monotonic(), last_step(server.output())
                samples, arrived, acted, next_act = [], [len(page.images)], 0, start
                while (now := time.monotonic()) < start + options.seconds:
                    if now >= next_act:
                        next(acts)()
                        acted, next_act = acted + 1, now + 5
                    page.drag(200, 250, 200 + chance.uniform(-80, 80), 250 + chance.uniform(-30, 30), seconds=0.5)
                    samples.append((now - start, resident(server.process.pid), last_step(server.output())))
                    if now - start > SLICE * len(arrived):
                        arrived.append(len(page.images))
                arrived.append(len(page.images))
                errors = list(page.errors)
            listening, complaints = server.listens(), server.complaints()
        finally:
            server.stop()

    seconds, memory, steps = np.array(samples, dtype=float).T
    late = seconds > seconds[-1] / 2
    growth = float(np.polyfit(seconds[late], memory[late], 1)[0]) * 60
    slices = np.diff(arrived).tolist()
    result = {
        "seconds": round(float(seconds[-1]), 1),
        "steps": int(steps[-1]) - first_step,
        "controls_used": acted,
        "camera_moves": len(samples),
        "images": arrived[-1] - arrived[0],
        "images_in_the_poorest_30_s": min(slices),
        "page_errors": errors,
        "log_errors": complaints,
        "host_mb_first": round(float(memory[0]), 1),
        "host_mb_middle": round(float(memory[late][0]), 1),
        "host_mb_last": round(float(memory[-1]), 1),
        "host_mb_a_minute_second_half": round(growth, 2),
        "device": torch.cuda.get_device_name(0) if torch.cuda.is_available() else "cpu",
    }
    print(json.dumps(result))
    stuck = min(slices) == 0 or steps[-1] <= steps[late][0]
    sys.exit(int(stuck or bool(errors) or bool(complaints) or not listening or growth > options.allowed))


if __name__ == "__main__":
    main()
