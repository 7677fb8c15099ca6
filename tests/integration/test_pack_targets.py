"""``sundae pack`` with a target of bytes or of quality, on a finished run."""

import json
import re
import shutil
from typing import NamedTuple

import pytest
import torch

from sundae_ns.cli import main
from sundae_ns.core.errors import PackError
from sundae_ns.core.metrics import Quality
from sundae_ns.io.pack.codecs import Codecs
from sundae_ns.io.pack.config import FINETUNED, PackConfig
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene, pack_bytes, read_scene
from sundae_ns.io.pack.quantize import Transform
from sundae_ns.plugin import tuned_packs
from sundae_ns.plugin.finished_runs import load_run
from sundae_ns.plugin.tuned_packs import COARSEST, Candidate, Search, best_pack, scaled
from sundae_ns.scene.packing import contents_of


def packed(capsys, *words):
    with pytest.raises(SystemExit, match="0"):
        main(["pack", *map(str, words), "--json"])
    found = json.loads(capsys.readouterr().out)
    return found


def test_a_target_of_bytes_is_met_and_used(tiny, tmp_path, capsys):
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

    before, cameras, all_cameras = Quality((30.0,), (0.9,)), 3, 3

    def __init__(self, drop):
        self.drop = drop

    def quality(self, _, codecs):
        return Quality((30 - self.drop(codecs.config),), (0.9,))


def search(run, drop, config=None):
    scene = contents_of(load_run(run, max_cameras=0))
    return Search(scene, config or PackConfig(), lambda: Stated(drop))


def test_the_search_uses_what_is_allowed(tiny):
    """With a loss that grows with the steps, from below the default to above it."""
    with_steps = search(tiny.folder, lambda config: config.harmonics_step)
    for limit in (0.01, 0.1):
        found = with_steps.better_than(limit)
        assert 0.95 * limit < found.codecs.config.harmonics_step <= limit


def test_a_target_is_never_larger_than_a_default_that_meets_it(tiny):
    """Even where finer steps happen to lose more."""
    by_chance = search(tiny.folder, lambda config: 0.06 if config.harmonics_step == 0.02 else 0.3)
    default = by_chance.default
    found = by_chance.better_than(0.2)
    assert (found.bytes, by_chance.drop(found)) == (default.bytes, pytest.approx(0.06))
    with pytest.raises(PackError, match=r"the finest pack loses 0\.300 dB"):
        by_chance.better_than(0.01)
    found = by_chance.smaller_than(int(1.2 * default.bytes))
    assert found.bytes == default.bytes


def test_the_quality_before_and_after_is_stated(tiny, tmp_path, capsys):
    found = packed(capsys, tiny.folder, "-o", tmp_path / "a.sundae", "--target-drop", 0.005)
    (before, after), (before_ssim, after_ssim) = found["psnr"], found["ssim"]
    assert before - 0.005 <= after < before + 0.05
    assert after_ssim == pytest.approx(before_ssim, abs=0.002)
    assert found["views"] == 3


def test_positions_are_rounded_once(tiny, tmp_path, capsys):
    """By the steps that the search finds, not by those that it begins with."""
    exact = contents_of(load_run(tiny.folder, max_cameras=0)).gaussians["means"].double()
    errors = []
    for words in ([], ["--target-bytes", 10**7]):
        file = tmp_path / f"{len(words)}.sundae"
        packed(capsys, tiny.folder, "-o", file, "--position-bits", 10, *words)
        distances = torch.cdist(exact, read_scene(file).gaussians["means"].double())
        errors.append(float(distances.amin(dim=1).max()))
    assert errors[1] < errors[0] / 4  # three bits more


class Faithful(Stated):
    """Judges a fine-tuned scene: other bases than those of its training lose 1 dB more."""

    def __init__(self, trained, drop):
        super().__init__(drop)
        self.trained = trained

    def quality(self, scene, codecs):
        pairs = [
            (codecs.gaussians[name], one) for name, one in self.trained.gaussians.items() if isinstance(one, Transform)
        ]
        same = all(isinstance(a, Transform) and torch.equal(a.basis, b.basis) for a, b in pairs)
        return Quality((super().quality(scene, codecs).psnr - (0 if same else 1),), (0.9,))


class Tuned(NamedTuple):
    scene: PackedScene
    codecs: Codecs
    bytes: int
    """Of the pack without a target."""

    def search(self, drop):
        return Search(self.scene, self.codecs, lambda: Faithful(self.codecs, drop))


@pytest.fixture(scope="module")
def tuned(tiny):
    """A scene whose rows have moved since its codecs were fitted, as training moves them."""
    config = PackConfig(**FINETUNED)
    scene, codecs = fit_scene(contents_of(load_run(tiny.folder, max_cameras=0)), config)
    generator = torch.Generator().manual_seed(0)
    for name in codecs.gaussians:
        scene.gaussians[name] += 0.3 * torch.randn(scene.gaussians[name].shape, generator=generator)
    return Tuned(scene, codecs, len(pack_bytes(scene, codecs)[0]))


def test_a_target_begins_with_the_pack_of_the_fine_tune(tuned):
    """Not with grids, bases and steps that are fitted anew, which the training did not know."""
    search = tuned.search(lambda config: config.harmonics_step)
    assert search.default == (tuned.scene, tuned.codecs, tuned.bytes)
    lost = FINETUNED["harmonics_step"]
    for limit, least in ((lost, 0.95 * lost), (2 * lost, 1.9 * lost), (0.5 * lost, 0.45 * lost)):
        found = search.better_than(limit)
        assert (found.bytes <= tuned.bytes) == (limit >= lost)
        assert least <= search.drop(found) <= limit
        # Positions are rounded once.
        assert found.codecs.blocks is tuned.codecs.blocks
    found = search.smaller_than(tuned.bytes)
    assert found.bytes <= tuned.bytes
    assert search.drop(found) <= lost


def test_a_fine_tune_that_does_not_help_is_left_out(tiny, tuned):
    plain = search(tiny.folder, lambda config: config.harmonics_step)
    plain_default = plain.default.bytes
    assert tuned.bytes < plain_default
    good, bad = tuned.search(lambda _: 0.01), tuned.search(lambda _: 0.5)
    for searches in ([plain, good], [good, plain]):
        found = best_pack(searches, most_drop=0.02)
        assert found.scene is tuned.scene
        assert found.bytes <= tuned.bytes
        for limit in (tuned.bytes, plain_default):
            assert best_pack(searches, most_bytes=limit).scene is tuned.scene
    for searches in ([plain, bad], [bad, plain]):
        found = best_pack(searches, most_drop=0.02)
        assert found.scene is not tuned.scene
        assert found.bytes <= plain_default
        for limit in (tuned.bytes, plain_default):
            found = best_pack(searches, most_bytes=limit)
            assert found.bytes <= limit
            assert found.scene is not tuned.scene
    with pytest.raises(PackError, match=r"the finest pack loses 0\.500 dB"):
        best_pack([bad, plain], most_drop=0.0001)


def test_coarser_steps_that_take_more_bytes_are_not_taken(tuned):
    class Growing(Search):
        def at(self, power):
            return Candidate(self.scene, tuned.codecs, round(100 + 10 * power))

    assert Growing(tuned.scene, tuned.codecs, lambda: Stated(lambda _: 0.0)).better_than(0.1).bytes == 100


def test_targets_that_cannot_be_met(tiny, tmp_path, capsys):
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


def test_a_pack_is_worth_its_bytes_at_the_price_of_trials():
    assert tuned_packs.is_worth(30.0, 100, 30.0, 100)
    assert tuned_packs.is_worth(29.7, 50, 30.0, 100)
    assert not tuned_packs.is_worth(29.5, 50, 30.0, 100)  # half of the bytes are worth 0.4 dB


def test_a_fine_tune_that_loses_says_so(tiny, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(tuned_packs, "is_worth", lambda *_: False)
    plain = packed(capsys, tiny.folder, "-o", tmp_path / "plain.sundae")
    words = [tiny.folder, "-o", tmp_path / "a.sundae", "--finetune", 1, "--head-step", "0.021", "--color-step", "1"]
    with pytest.raises(SystemExit, match="0"):
        main(["pack", *map(str, words)])
    lost = capsys.readouterr()
    assert re.search(r"PSNR \d+\.\d\d -> \d+\.\d\d dB, SSIM 0", lost.out)
    assert re.search(r"the fine-tune of 1 steps loses \d\.\d\d dB; a pack without it has [\d,]+ bytes", lost.err)
    assert plain["psnr"][1] < plain["psnr"][0] + 0.1


def test_a_pack_without_its_capture_says_that_it_is_not_measured(tiny, tmp_path, capsys):
    shutil.copytree(tiny.folder, tmp_path / "run")
    config = tmp_path / "run" / "config.yml"
    config.write_text(config.read_text().replace(f"- {tiny.scene.name}\n", "- elsewhere\n"))
    with pytest.raises(SystemExit, match="0"):
        main(["pack", str(tmp_path / "run"), "-o", str(tmp_path / "a.sundae"), "--max-cameras", "0"])
    shown = capsys.readouterr()
    assert "PSNR" not in shown.out
    assert re.match(r"the quality is not measured: the capture .*elsewhere is missing; give its folder", shown.err)


def test_steps_grow_together():
    finer, coarser = scaled(PackConfig(), -1.0), scaled(PackConfig(), 2.0)
    assert finer.harmonics_step == PackConfig().harmonics_step / 2
    assert coarser.opacity_step == 4 * PackConfig().opacity_step
    assert (finer.position_bits, coarser.position_bits) == (14, 11)
    for power in (-40.0, 40.0):
        scaled(PackConfig(), power).validate()
