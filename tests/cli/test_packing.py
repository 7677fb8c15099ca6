"""Options of ``sundae pack``, and refusals in one line."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import run


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["pack", "nothing", "-o", "a.sundae"], "nothing cannot be read"),
        (["pack", "nothing", "-o", "a.sundae", "--scale-step", "2"], "scale-step is 2.0; give 0.0001 to 1"),
        (["pack", "nothing", "-o", "cut.sundae/a.sundae"], "cut.sundae is no folder; choose another"),
        (["pack", "nothing", "-o", "a.sundae", "--finetune", "-1"], "finetune is -1"),
        (["pack", "nothing", "-o", "a.sundae", "--max-cameras", "-1"], "max-cameras is -1"),
        (["pack", "nothing", "-o", "a.sundae", "--target-bytes", "0"], "target-bytes is 0"),
        (["pack", "nothing", "-o", "a.sundae", "--target-drop", "nan"], "target-drop is nan"),
        (["pack", "nothing", "-o", "a.sundae", "--target-drop", "1", "--target-bytes", "9"], "exclude each other"),
    ],
)
def test_refusals_are_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("cut.sundae").touch()
    before = sorted(tmp_path.iterdir())
    assert run(*arguments) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("sundae: ")
    assert message in line
    assert sorted(tmp_path.iterdir()) == before
