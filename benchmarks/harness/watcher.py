"""A viewer without a browser: it connects to nerfstudio's viewer as its page does, moves its camera, counts images."""

from __future__ import annotations

import math
import socket
import threading
from contextlib import suppress
from dataclasses import asdict

import msgspec
from viser._messages import ViewerCameraMessage
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

EVERY = 0.2
"""Seconds between two moves."""


def free_port() -> int:
    """A port of this machine's loopback on which nothing listens."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


class Watcher(threading.Thread):
    """Watches a viewer until :meth:`stop`; connects again if there is no viewer, or no more.

    Args:
        port: of the viewer, on this machine's loopback.
    """

    def __init__(self, port: int) -> None:
        super().__init__(daemon=True)
        self._address, self._over = f"ws://127.0.0.1:{port}", threading.Event()
        self.images = 0
        """Number of images that came."""
        self.start()

    def run(self) -> None:
        """Connect, move and count."""
        while not self._over.wait(0.1):
            with suppress(OSError, WebSocketException), connect(self._address, max_size=None, open_timeout=5) as socket:
                moves = 0
                while not self._over.is_set():
                    socket.send(_camera(moves / 10))
                    moves += 1
                    with suppress(TimeoutError):
                        while True:
                            frame = socket.recv(EVERY)
                            self.images += b"BackgroundImageMessage" in (frame if isinstance(frame, bytes) else b"")

    def stop(self) -> None:
        """Disconnect, and wait for it."""
        self._over.set()
        self.join()


def _camera(angle: float) -> bytes:
    """A camera on a circle around the scene, as the page sends it."""
    half = angle / 2
    message = ViewerCameraMessage(
        wxyz=(math.cos(half), 0.0, 0.0, math.sin(half)),
        position=(3 * math.sin(angle), -3 * math.cos(angle), 1.0),
        fov=1.0,
        aspect=1.0,
        look_at=(0.0, 0.0, 0.0),
        up_direction=(0.0, 0.0, 1.0),
    )
    return msgspec.msgpack.encode({"type": type(message).__name__, **asdict(message)})
