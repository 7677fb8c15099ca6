"""Options of ``sundae pack``, and refusals in one line."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields
from pathlib import Path

import pytest
from command_line import run

from sundae_ns.cli.packing import Precision, pack
from sundae_ns.storage.pack import FINETUNED, PackConfig


def test_options_are_those_of_the_configuration() -> None:
    """They are repeated in the command, so that ``sundae --help`` does not import torch."""
    defaults = {field.name: field.default for field in fields(PackConfig)}
    assert inspect.signature(pack).parameters["block"].default == defaults.pop("block")
    assert {field.name for field in fields(Precision)} == set(FINETUNED) == set(defaults)
    source = inspect.getsource(Precision)
    for name, default in defaults.items():
        (line,) = re.findall(rf'^    {name}: .*\n    """(.*)"""$', source, re.MULTILINE)
        assert line.endswith(f"; by default {default}, {FINETUNED[name]} with a fine-tune.")
        assert getattr(Precision(), name) is None


def test_the_options_of_precision_have_no_prefix(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("pack", "--help") == 0
    shown = capsys.readouterr().out
    assert "--position-bits" in shown
    assert "--precision" not in shown


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
