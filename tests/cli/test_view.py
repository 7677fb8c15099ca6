"""``sundae view``."""

from __future__ import annotations

import threading
import urllib.error
import urllib.request
import webbrowser
from pathlib import Path

import pytest
from packed_scenes import KINDS, write_kind

from sundae_ns.cli import main
from sundae_ns.cli import view as command
from sundae_ns.errors import ConfigError


def test_the_server_has_one_page_and_listens_on_this_machine_only() -> None:
    with command.serve("<p>a scene</p>", 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        host, port = server.server_address[:2]
        assert host == "127.0.0.1"
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as answer:
            assert answer.read() == b"<p>a scene</p>"
            assert answer.headers["Content-Type"] == "text/html; charset=utf-8"
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"http://127.0.0.1:{port}/etc/passwd")
        with pytest.raises(ConfigError, match=f"port {port} cannot be used"):
            command.serve("", port)
        server.shutdown()


@pytest.mark.parametrize("opens", [True, False])
def test_view_opens_the_page(
    opens: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    packed = write_kind(tmp_path / "a.sundae", KINDS["no head, degree 3"])
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)

    def serve(server: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("http.server.ThreadingHTTPServer.serve_forever", serve)
    with pytest.raises(SystemExit) as caught:
        main(["view", str(packed), *([] if opens else ["--no-open-browser"])])
    assert caught.value.code == 0
    (line,) = capsys.readouterr().out.strip().splitlines()
    assert len(opened) == opens
    assert all(address in line for address in opened)
