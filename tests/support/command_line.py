"""``sundae`` in this process."""

from __future__ import annotations

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
