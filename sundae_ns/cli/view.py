"""``sundae view``: show a scene in the browser."""

from __future__ import annotations

import webbrowser
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Annotated

import tyro

from sundae_ns.cli.files import open_packed_file
from sundae_ns.errors import ConfigError


def serve(page: str, port: int) -> ThreadingHTTPServer:
    """A server of one page on 127.0.0.1, not yet started.

    Raises:
        ConfigError: the port is in use or not allowed.
    """
    content = page.encode()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            """Answer with the page."""
            found = self.path == "/"
            self.send_response(200 if found else 404)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(content) if found else 0))
            self.end_headers()
            if found:
                self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002
            """Stay silent."""

    try:
        return ThreadingHTTPServer(("127.0.0.1", port), Handler)
    except (OSError, OverflowError) as error:
        raise ConfigError(f"port {port} cannot be used ({error}); choose another, or 0 for a free one") from error


def view(
    scene: Annotated[Path, tyro.conf.Positional], port: int = 0, open_browser: bool = True, data: Path | None = None
) -> int:
    """Show a scene with its head in the browser, until Ctrl-C.

    Serves the page of sundae export on 127.0.0.1 and opens it. From another machine, forward the port by ssh -L.

    Args:
        scene: a packed scene, or a run (its folder or config.yml).
        port: port on 127.0.0.1; 0 takes a free one.
        open_browser: open the default browser; otherwise only print the address.
        data: folder of the capture of a run, if it moved.
    """
    from sundae_ns.api.page import page_of

    page = page_of(*open_packed_file(scene, data), title=scene.resolve().stem)
    with serve(page, port) as server:
        address = f"http://127.0.0.1:{server.server_port}/"
        print(f"{scene} is shown at {address} until Ctrl-C", flush=True)
        if open_browser:
            webbrowser.open(address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()
    return 0
