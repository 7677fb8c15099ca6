"""A driver of a headless Chromium by its DevTools protocol, JSON over a websocket; viser brings the websocket library.

The browser needs no display, renders WebGL in software, resolves no host names, and reaches only the loopback.
"""

from __future__ import annotations

import base64
import io
import itertools
import json
import os
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple, Self

import msgspec
import numpy as np
from numpy.typing import NDArray
from PIL import Image
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


class BrowserError(RuntimeError):
    """The browser did not react in time, or refused a call."""


class Camera(NamedTuple):
    """Camera of the page, from its last message to the viewer: OpenCV axes, in the viewer's units."""

    wxyz: tuple[float, ...]
    position: tuple[float, ...]
    fov: float  # vertical, radian
    aspect: float


class Browser:
    """One page of a headless Chromium, a context manager; ``executable`` is that of :func:`find_chromium`."""

    def __init__(self, executable: str, width: int = 960, height: int = 640, flags: Sequence[str] = ()) -> None:
        size = f"--window-size={width},{height}"
        self._command = [executable, *FLAGS, *flags, ONLY_LOOPBACK, size, "about:blank"]
        self._size = (width, height)
        self._stack = ExitStack()
        self._answers: dict[int, Future[dict[str, Any]]] = {}
        self._numbers = itertools.count(1)
        self.errors: list[str] = []
        """What the page wrote to its console as an error, and exceptions that it did not catch; without ``KNOWN``."""
        self.camera: Camera | None = None
        self.images: list[tuple[int, int]] = []
        """Width and height of every image that the viewer has sent."""

    def __enter__(self) -> Self:
        try:
            self._start()
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
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
                end = (profile / "log").read_text()[-500:]
                raise BrowserError(f"the browser ended with {process.returncode}: {end}")
            return address.exists() and address.read_text().count("\n") == 1

        wait_for(ready, "the browser's port", 60)
        port, path = address.read_text().split("\n")
        usual: dict[str, Any] = {"max_size": None, "compression": None, "open_timeout": 60, "ping_interval": None}
        self._socket = self._stack.enter_context(connect(f"ws://127.0.0.1:{port}{path}", **usual))
        threading.Thread(target=self._listen, daemon=True).start()
        targets = self.call("Target.getTargets", browser=True)["targetInfos"]
        page = next(target["targetId"] for target in targets if target["type"] == "page")
        self._page = self.call("Target.attachToTarget", {"targetId": page, "flatten": True}, browser=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        # The page talks to the viewer in a worker; it waits at its start until its messages are recorded.
        self.call("Target.setAutoAttach", {"autoAttach": True, "waitForDebuggerOnStart": True, "flatten": True})
        metrics = {**dict(zip(("width", "height"), self._size)), "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", metrics)

    def _end(self, process: subprocess.Popen[bytes]) -> None:
        with suppress(BrowserError, ConnectionClosed, AttributeError):
            self.call("Browser.close", browser=True, timeout=5)
        with suppress(subprocess.TimeoutExpired):
            process.wait(3)
        # Its renderers too, which take their time where WebGL is drawn in software.
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def call(
        self, method: str, params: dict[str, Any] | None = None, *, browser: bool = False, timeout: float = 60
    ) -> dict[str, Any]:
        """Result of a call to the page or to the browser itself; ``BrowserError`` if it fails or takes too long."""
        try:
            message = self._send(method, params, None if browser else self._page).result(timeout)
        except TimeoutError as error:
            raise BrowserError(f"{method} took more than {timeout} s") from error
        if "error" in message:
            raise BrowserError(f"{method}: {message['error'].get('message')}")
        return dict(message["result"])

    def _send(self, method: str, params: dict[str, Any] | None, session: str | None) -> Future[dict[str, Any]]:
        number = next(self._numbers)
        answer = self._answers[number] = Future()
        message = {"id": number, "method": method, "params": params or {}}
        self._socket.send(json.dumps(message if session is None else {**message, "sessionId": session}))
        return answer

    def _listen(self) -> None:
        with suppress(ConnectionClosed):
            for text in self._socket:
                message = json.loads(text)
                if "id" in message:
                    self._answers.pop(message["id"]).set_result(message)
                else:
                    self._on_event(message["method"], message["params"])
        while self._answers:
            self._answers.popitem()[1].set_result({"error": {"message": "the browser is gone"}})

    def _on_event(self, method: str, params: dict[str, Any]) -> None:
        if method == "Target.attachedToTarget":
            session = params["sessionId"]
            for name in ("Runtime.enable", "Network.enable", "Runtime.runIfWaitingForDebugger"):
                self._send(name, None, session)
        elif method in ("Network.webSocketFrameSent", "Network.webSocketFrameReceived"):
            for part in _messages(params["response"]):
                self._on_message(part)
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

    def _on_message(self, part: dict[str, Any]) -> None:
        """Note what viser's page and server tell each other."""
        if part.get("type") == "ViewerCameraMessage":
            place = tuple(part["wxyz"]), tuple(part["position"])
            self.camera = Camera(*place, float(part["fov"]), float(part["aspect"]))
        elif part.get("type") == "BackgroundImageMessage":
            with Image.open(io.BytesIO(part["rgb_bytes"])) as image:
                self.images.append(image.size)

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
        self.drag(x, y, x, y, steps=0)

    def drag(self, x: float, y: float, to_x: float, to_y: float, steps: int = 8, seconds: float = 0.0) -> None:
        """Press at one pixel and release at another, through ``steps`` in between."""
        self.mouse("mouseMoved", x, y)
        self.mouse("mousePressed", x, y, pressed=True)
        for i in range(1, steps + 1):
            self.mouse("mouseMoved", x + (to_x - x) * i / steps, y + (to_y - y) * i / steps, pressed=True)
            time.sleep(seconds / steps)
        self.mouse("mouseReleased", to_x, to_y)

    def key(self, name: str, code: int) -> None:
        """Press and release a key by its DOM name and its virtual key code."""
        event = {"key": name, "code": name, "windowsVirtualKeyCode": code}
        self.call("Input.dispatchKeyEvent", {"type": "keyDown", **event})
        self.call("Input.dispatchKeyEvent", {"type": "keyUp", **event})


def _messages(response: dict[str, Any]) -> list[dict[str, Any]]:
    """viser's messages in a frame: one, or a batch; none in a frame that is not binary."""
    content = msgspec.msgpack.decode(base64.b64decode(response["payloadData"])) if response["opcode"] == 2 else []
    if isinstance(content, dict):
        content = content.get("messages", [content])
    return [part for part in content if isinstance(part, dict)] if isinstance(content, list) else []


def wait_for(ready: Callable[[], bool], what: str, seconds: float) -> None:
    """Return as soon as ``ready()``; ``BrowserError`` if it is not in this time."""
    end = time.monotonic() + seconds
    while not ready():
        if time.monotonic() > end:
            raise BrowserError(f"waited {seconds:g} s for {what}")
        time.sleep(0.05)
