"""``sundae pack`` with a target of bytes or of quality, on a finished run."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from sundae_ns.cli import main
from sundae_ns.errors import PackError
from sundae_ns.scenes.packed import contents_of_run
from sundae_ns.scenes.targets import COARSEST, Judge, Quality, Search, scaled
from sundae_ns.storage.packing import FINETUNED, Codecs, PackConfig, PackedScene, read_header, read_scene


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


class Stated:
    """Judges packs by a function of their options; a finished run has 30 dB."""

    before, views, all_views = Quality(30.0, 0.9), 3, 3

    def __init__(self, drop: Callable[[PackConfig], float]) -> None:
        self.drop = drop

    def quality(self, _: PackedScene, codecs: Codecs) -> Quality:
        return Quality(30 - self.drop(codecs.config), 0.9)


def search(run: Path, drop: Callable[[PackConfig], float], config: PackConfig | None = None) -> Search:
    scene = contents_of_run(run, max_cameras=0)
    return Search(scene, config or PackConfig(), lambda: Stated(drop))  # type: ignore[arg-type, return-value]


def test_a_target_of_quality_is_met(tiny: Any) -> None:
    found = Search(contents_of_run(tiny.folder, max_cameras=0), PackConfig(), lambda: Judge(tiny.folder, None))
    assert found.drop(found.better_than(0.02)) <= 0.02


def test_the_search_uses_what_is_allowed(tiny: Any) -> None:
    """With a loss that grows with the steps, from below the default to above it."""
    with_steps = search(tiny.folder, lambda config: config.harmonics_step)
    for limit in (0.01, 0.1):
        found = with_steps.better_than(limit)
        assert 0.95 * limit < found.codecs.config.harmonics_step <= limit


def test_a_target_is_never_larger_than_a_default_that_meets_it(tiny: Any) -> None:
    """Even where finer steps happen to lose more."""
    by_chance = search(tiny.folder, lambda config: 0.06 if config.harmonics_step == 0.02 else 0.3)
    default = by_chance._tried(0.0)
    found = by_chance.better_than(0.2)
    assert (found.bytes, by_chance.drop(found)) == (default.bytes, pytest.approx(0.06))
    with pytest.raises(PackError, match=r"the finest pack loses 0\.300 dB"):
        by_chance.better_than(0.01)
    found = by_chance.smaller_than(int(1.2 * default.bytes))
    assert found.bytes == default.bytes


def test_the_quality_before_and_after_is_stated(tiny: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = packed(capsys, tiny.folder, "-o", tmp_path / "a.sundae", "--target-drop", 0.005)
    (before, after), (before_ssim, after_ssim) = found["psnr"], found["ssim"]
    assert before - 0.005 <= after < before + 0.05
    assert after_ssim == pytest.approx(before_ssim, abs=0.002)
    assert found["views"] == 3


def test_positions_are_rounded_once(tiny: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By the steps that the search finds, not by those that it begins with."""
    exact = contents_of_run(tiny.folder, max_cameras=0).field["means"].double()
    errors = []
    for words in ([], ["--target-bytes", 10**7]):
        file = tmp_path / f"{len(words)}.sundae"
        packed(capsys, tiny.folder, "-o", file, "--position-bits", 10, *words)
        distances = torch.cdist(exact, read_scene(file).field["means"].double())
        errors.append(float(distances.amin(dim=1).max()))
    assert errors[1] < errors[0] / 4  # three bits more


def test_a_fine_tune_that_loses_too_much_is_left_out(tiny: Any) -> None:
    scene = contents_of_run(tiny.folder, max_cameras=0)
    tuned_scene = replace(scene, meta={**scene.meta, "source": {"finetuned": 100}})
    coarse = PackConfig(**FINETUNED)  # type: ignore[arg-type]

    def tuned(lost: float) -> Search:
        return Search(tuned_scene, coarse, lambda: Stated(lambda _: lost))  # type: ignore[arg-type, return-value]

    plain = search(tiny.folder, lambda config: config.harmonics_step)
    assert tuned(0.5).better_unless(0.1, plain) is None
    found = tuned(0.05).better_unless(0.1, plain)
    assert found is not None
    assert found.bytes < plain.better_than(0.1).bytes
    # The positions of a fine-tuned scene keep their grid.
    assert found.codecs.config.position_bits == coarse.position_bits


def test_targets_that_cannot_be_met(tiny: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One line with the smallest size and its loss, and no file."""
    with pytest.raises(SystemExit, match="2"):
        main(["pack", str(tiny.folder), "-o", str(tmp_path / "a.sundae"), "--target-bytes", "500"])
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "the smallest pack has " in line
    assert "bytes and loses " in line
    assert not list(tmp_path.iterdir())
    with pytest.raises(
        PackError, match=r"the finest pack loses 0\.50* dB at [\d,]+ bytes; give a larger --target-drop"
    ):
        search(tiny.folder, lambda _: 0.5, scaled(PackConfig(), COARSEST)).better_than(0.1)


def test_a_fine_tune_that_loses_says_so(tiny: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = packed(capsys, tiny.folder, "-o", tmp_path / "plain.sundae")
    words = [tiny.folder, "-o", tmp_path / "a.sundae", "--finetune", 1, "--head-step", "0.02", "--color-step", "1"]
    with pytest.raises(SystemExit, match="0"):
        main(["pack", *map(str, words)])
    lost = capsys.readouterr()
    assert re.search(r"PSNR \d+\.\d\d -> \d+\.\d\d dB, SSIM 0", lost.out)
    assert re.search(r"the fine-tune of 1 steps loses \d\.\d\d dB; a pack without it has [\d,]+ bytes", lost.err)
    assert plain["psnr"][1] < plain["psnr"][0] + 0.1


def test_a_pack_without_its_capture_says_that_it_is_not_measured(
    tiny: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(tiny.folder, tmp_path / "run")
    config = tmp_path / "run" / "config.yml"
    config.write_text(config.read_text().replace(f"- {tiny.scene.name}\n", "- elsewhere\n"))
    with pytest.raises(SystemExit, match="0"):
        main(["pack", str(tmp_path / "run"), "-o", str(tmp_path / "a.sundae"), "--max-cameras", "0"])
    shown = capsys.readouterr()
    assert "PSNR" not in shown.out
    assert re.match(r"the quality is not measured: the capture .*elsewhere is missing; give its folder", shown.err)


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
