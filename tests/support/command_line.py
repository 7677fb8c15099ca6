"""``sundae`` in this process, and servers beside it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import ThreadingHTTPServer

import pytest

from sundae_ns.cli import main


def run(*words: object) -> int:
    """The exit code of a command."""
    with pytest.raises(SystemExit) as caught:
        main([str(word) for word in words])
    assert isinstance(caught.value.code, int)
    return caught.value.code


def refusal(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The one line with which a command is refused."""
    assert run(*words) == 2
    (line,) = [line for line in capsys.readouterr().err.strip().splitlines() if "compiling the CPU" not in line]
    assert line.startswith("sundae: ")
    return line


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed, in one line, since terminals break lines anywhere."""
    return " ".join(capsys.readouterr().out.split())


@contextmanager
def served(server: ThreadingHTTPServer) -> Iterator[int]:
    """The port of a server of this machine, which runs."""
    with server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        host, port = server.server_address[:2]
        assert host == "127.0.0.1"
        yield port
        server.shutdown()
