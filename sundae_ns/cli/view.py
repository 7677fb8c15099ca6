"""``sundae view``: show a scene in the browser."""

from __future__ import annotations

import sys
import webbrowser
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from sundae_ns.cli.inputs import opened
from sundae_ns.cli.options import Advanced, Flag, Plain, Scene, SceneDetails, Wishes
from sundae_ns.core.errors import ConfigError
from sundae_ns.scene.page import page_of

IDLE_SECONDS = 15.0  # a connection that sends or takes nothing for this time is closed


class _Server(ThreadingHTTPServer):
    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exc_info()[1], OSError):  # a browser may leave early
            super().handle_error(request, client_address)


def serve(page: str, port: int) -> ThreadingHTTPServer:
    """A server of one page on 127.0.0.1, not yet started.

    It answers only requests that name this machine: a site whose name resolves to 127.0.0.1 could read others.
    """
    content = page.encode(errors="backslashreplace")

    class Handler(BaseHTTPRequestHandler):
        timeout = IDLE_SECONDS

        def do_GET(self) -> None:
            port = self.connection.getsockname()[1]
            named = [name.strip().lower() for name in self.headers.get_all("Host", [])]
            status, body = (200, content) if self.path == "/" else (404, b"")
            if len(named) != 1 or named[0] not in _hosts(port):
                status, body = 421, b"Open http://127.0.0.1:%d/; forward it from a port of the same number." % port
            self.send_response(status)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            # The time limit holds for each call, so a slow connection gets the page in pieces.
            for start in range(0, len(body), 1 << 16):
                self.wfile.write(body[start : start + (1 << 16)])

        def log_message(self, *_: object) -> None:
            """Print nothing."""

    try:
        return _Server(("127.0.0.1", port), Handler)
    except (OSError, OverflowError) as error:
        raise ConfigError(f"port {port} cannot be used ({error}); choose another, or 0 for a free one") from error


def _hosts(port: int) -> set[str]:
    """Values of the header ``Host`` that name this machine; browsers leave out port 80."""
    names = {"127.0.0.1", "localhost", "[::1]"}
    return {f"{name}:{port}" for name in names} | (names if port == 80 else set())


def view(
    scene: Scene,
    port: int = 0,
    no_open_browser: Flag = False,
    wishes: Plain[Wishes] = Wishes(),  # noqa: B008
    advanced: Advanced[SceneDetails] = SceneDetails(),  # noqa: B008
) -> int:
    """Show a scene with its head in the browser, until Ctrl-C.

    Serves the page of sundae export on 127.0.0.1 and opens it. From another machine, forward the port to the same
    number: ssh -L 8000:127.0.0.1:8000 with --port 8000.

    Args:
        port: port on 127.0.0.1; 0 takes a free one.
        no_open_browser: only print the address, and open no browser.
    """
    page = page_of(opened(scene, wishes, advanced, capture=True).for_page())
    with serve(page, port) as server, suppress(KeyboardInterrupt):
        address = f"http://127.0.0.1:{server.server_port}/"
        print(f"{scene} is shown at {address} until Ctrl-C", flush=True)
        if not no_open_browser:
            webbrowser.open(address)
        server.serve_forever()
    return 0
