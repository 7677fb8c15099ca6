"""``sundae pack`` with a target of bytes or of quality, on a finished run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sundae_ns.cli import main
from sundae_ns.errors import PackError
from sundae_ns.scenes import targets
from sundae_ns.scenes.packed import contents_of_run
from sundae_ns.scenes.targets import COARSEST, Search, scaled
from sundae_ns.storage.packing import PackConfig, read_header


def packed(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    with pytest.raises(SystemExit, match="0"):
        main(["pack", *map(str, words), "--json"])
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_a_target_of_bytes_is_met_and_used(tiny: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = packed(capsys, tiny.folder, "-o", tmp_path / "a.sundae")
    assert plain["bytes"] == (tmp_path / "a.sundae").stat().st_size
    assert sum(value for name, value in plain["bits"].items() if name != "all") == pytest.approx(
        plain["bits"]["all"], abs=0.1
    )
    for share in (0.8, 1.1):
        limit = int(share * plain["bytes"])
        found = packed(capsys, tiny.folder, "-o", tmp_path / f"{share}.sundae", "--target-bytes", limit)
        assert 0.93 * limit < found["bytes"] <= limit


def test_a_target_of_quality_is_met(tiny: Any) -> None:
    search = Search(tiny.folder, contents_of_run(tiny.folder, max_cameras=0), PackConfig())
    found = search.better_than(0.02)
    assert search.drop(found) <= 0.02


def test_the_search_uses_what_is_allowed(tiny: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a loss that grows with the steps."""
    monkeypatch.setattr(targets, "_drop_of", lambda *_: lambda _, codecs: codecs.config.harmonics_step)
    search = Search(tiny.folder, contents_of_run(tiny.folder, max_cameras=0), PackConfig())
    for limit in (0.01, 0.1):
        found = search.better_than(limit)
        assert 0.95 * limit < found.codecs.config.harmonics_step <= limit


def test_targets_that_cannot_be_met(
    tiny: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line with the smallest size and its loss, and no file."""
    with pytest.raises(SystemExit, match="2"):
        main(["pack", str(tiny.folder), "-o", str(tmp_path / "a.sundae"), "--target-bytes", "500"])
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "the smallest pack has " in line
    assert "bytes and loses " in line
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(targets, "_drop_of", lambda *_: lambda *_: 0.5)
    search = Search(tiny.folder, contents_of_run(tiny.folder, max_cameras=0), scaled(PackConfig(), COARSEST))
    with pytest.raises(
        PackError, match=r"the finest pack loses 0\.50* dB at [\d,]+ bytes; give a larger --target-drop"
    ):
        search.better_than(0.1)


def test_a_target_after_a_fine_tune(tiny: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "a.sundae"
    limit = int(0.8 * packed(capsys, tiny.folder, "-o", tmp_path / "plain.sundae")["bytes"])
    found = packed(capsys, tiny.folder, "-o", file, "--finetune", 3, "--target-bytes", limit)
    assert 0.9 * limit < found["bytes"] <= limit
    assert read_header(file).meta["source"]["finetuned"] == 3


def test_steps_grow_together() -> None:
    finer, coarser = scaled(PackConfig(), -1.0), scaled(PackConfig(), 2.0)
    assert finer.harmonics_step == PackConfig().harmonics_step / 2
    assert coarser.opacity_step == 4 * PackConfig().opacity_step
    assert (finer.position_bits, coarser.position_bits) == (14, 11)
    for power in (-40.0, 40.0):
        scaled(PackConfig(), power).validate()
