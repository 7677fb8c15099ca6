"""``sundae view``."""

import socket
import struct
import threading
import time
import urllib.error
import urllib.request
import webbrowser
from unittest.mock import Mock

import pytest
from command_line import run, served
from packed_scenes import KINDS, write_kind

from sundae_ns.cli import view as command
from sundae_ns.core.errors import ConfigError

SECONDS = 60  # time limit of what takes milliseconds, so only a hang reaches it


def connect(port):
    return socket.create_connection(("127.0.0.1", port), timeout=SECONDS)


def asked(port):
    """A connection that has asked for the page, and has taken none of it."""
    client = connect(port)
    client.sendall(f"GET / HTTP/1.1\r\nHost: localhost:{port}\r\n\r\n".encode())
    return client


def until_gone():
    """Wait until no connection is open."""
    last = time.monotonic() + SECONDS
    while any("process_request_thread" in thread.name for thread in threading.enumerate()):
        assert time.monotonic() < last, "the connection stays open"
        time.sleep(0.01)


def test_the_server_has_one_page_and_listens_on_this_machine_only():
    with served(command.serve("<p>a scene</p>", 0)) as port:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as answer:
            assert answer.read() == b"<p>a scene</p>"
            assert answer.headers["Content-Type"] == "text/html; charset=utf-8"
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"http://127.0.0.1:{port}/etc/passwd")
        with pytest.raises(ConfigError, match=f"port {port} cannot be used"):
            command.serve("", port)


def answer_to(port, *hosts):
    """Status and content of the answer to a request with these headers ``Host``."""
    with connect(port) as client:
        headers = "".join(f"Host: {host}\r\n" for host in hosts)
        client.sendall(f"GET / HTTP/1.0\r\n{headers}\r\n".encode())
        head, _, content = client.makefile("rb").read().partition(b"\r\n\r\n")
    return int(head.split()[1]), content


def test_only_this_machine_by_name_is_answered():
    """Another site whose name resolves to 127.0.0.1 must not read the scene."""
    with served(command.serve("a scene", 0)) as port:
        for host in ("127.0.0.1", "localhost", "[::1]", "LocalHost"):
            assert answer_to(port, f"{host}:{port}") == (200, b"a scene")
        wrong = ["evil.example", f"evil.example:{port}", "localhost", f"localhost:{port + 1}", f"127.0.0.1:{port}0", ""]
        for hosts in ([host] for host in [*wrong, f"localhost:{port}.evil.example", f"user@localhost:{port}"]):
            status, content = answer_to(port, *hosts)
            assert status == 421, hosts
            assert b"a scene" not in content
        assert answer_to(port)[0] == 421
        assert answer_to(port, f"localhost:{port}", f"evil.example:{port}")[0] == 421
    # On the default port browsers name no port.
    assert {"localhost", "127.0.0.1", "[::1]", "localhost:80"} <= command._hosts(80)
    assert "localhost" not in command._hosts(8080)


def test_idle_connections_end(monkeypatch):
    monkeypatch.setattr(command, "IDLE_SECONDS", 0.2)
    with served(command.serve("x" * (32 << 20), 0)) as port:
        for said in (b"", b"GET / HTTP/1.1\r\nHost: local"):
            with connect(port) as client:
                client.sendall(said)
                assert client.recv(1) == b""
        with asked(port) as client:
            assert client.recv(1)
            until_gone()


def test_a_slow_connection_gets_the_page(monkeypatch):
    monkeypatch.setattr(command, "IDLE_SECONDS", 0.5)
    # The kernel holds 10 MB of it; the client takes the rest in more seconds than a connection may idle.
    with served(command.serve("x" * (24 << 20), 0)) as port, asked(port) as client:
        received = 0
        while part := client.recv(1 << 20, socket.MSG_WAITALL):
            received += len(part)
            time.sleep(0.05)
        assert received > 24 << 20


def test_a_browser_that_leaves_causes_no_traceback(capfd):
    with served(command.serve("x" * (32 << 20), 0)) as port:
        with asked(port) as client:
            assert client.recv(1)
            # Close by a reset, as a browser does whose page is left while it loads.
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        until_gone()
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("opens", [True, False])
def test_view_opens_the_page(opens, tmp_path, monkeypatch, capsys):
    (tmp_path / "fox").mkdir()
    packed = write_kind(tmp_path / "fox" / "scene.sundae", KINDS["no head, degree 3"])
    opened, serve_page = [], Mock(side_effect=command.serve)
    monkeypatch.setattr(command, "serve", serve_page)
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr("http.server.ThreadingHTTPServer.serve_forever", Mock(side_effect=KeyboardInterrupt))
    assert run("view", packed, *([] if opens else ["--no-open-browser"])) == 0
    (line,) = capsys.readouterr().out.strip().splitlines()
    assert "<title>fox</title>" in serve_page.call_args.args[0]
    assert len(opened) == opens
    assert all(address in line for address in opened)
