"""``sundae pack`` on a finished run: what it says and stores, targets of bytes or quality, and the fine-tune."""

import json
import re
import shutil
from statistics import fmean
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from command_line import run
from kill_and_resume import contents

from sundae_ns.cli.pack import PackDetails, pack
from sundae_ns.core.errors import CheckpointError, ConfigError, MemoryExhaustedError
from sundae_ns.core.metrics import Quality, psnr
from sundae_ns.io.formats import read_gaussians
from sundae_ns.io.pack.codecs import Transform
from sundae_ns.io.pack.config import FINETUNED, STEPS, PackConfig
from sundae_ns.io.pack.container import read_header
from sundae_ns.io.pack.packed_scene import fit_scene, pack_bytes, read_scene, write_fitted
from sundae_ns.plugin import tuned_packs
from sundae_ns.plugin.finished_runs import load_model, load_run
from sundae_ns.plugin.optimizer_configs import rate_factor
from sundae_ns.plugin.tuned_packs import COARSEST, Candidate, RoundedTraining, Search, best_pack, finetune, scaled
from sundae_ns.scene.load_save import load
from sundae_ns.scene.packing import contents_of


@pytest.fixture(scope="module")
def scene(tiny):
    """The tiny run without cameras, to be packed; nothing changes it."""
    return contents_of(load_run(tiny.folder, max_cameras=0))


def quality(opened, name="rgb"):
    """Mean PSNR on the test views, dB."""
    with torch.no_grad():
        images = [opened.model.get_outputs_for_camera(camera)[name] for camera in opened.cameras]
    return fmean(float(psnr(image, truth)) for image, truth in zip(images, opened.truths, strict=True))


@pytest.fixture(scope="module")
def packed(tiny, tmp_path_factory):
    file = tmp_path_factory.mktemp("packed") / "tiny.sundae"
    assert run("pack", tiny.folder, "-o", file) == 0
    return file


def figures(capsys, *words):
    """What ``sundae pack`` prints with --json."""
    assert run("pack", *words, "--json") == 0
    return json.loads(capsys.readouterr().out)


def test_the_table_counts_every_byte(tiny, tmp_path, capsys):
    file = tmp_path / "a.sundae"
    assert run("pack", tiny.folder, "-o", file) == 0
    table, _, measured = capsys.readouterr().out.partition("bits per Gaussian")[2].partition("\nPSNR ")
    assert re.fullmatch(
        r"\d+\.\d\d -> \d+\.\d\d dB, SSIM 0\.\d{4} -> 0\.\d{4}, before and after, on 3 of 3 test views\n", measured
    )
    rows = {words[0]: int(words[1].replace(",", "")) for words in map(str.split, table.strip().splitlines())}
    assert rows.pop("all") == file.stat().st_size == sum(rows.values())
    assert {"means", "quats", "scales", "features", "head", "cameras", "header"} <= set(rows)


def test_a_packed_run_is_read(packed):
    """nerfstudio turns a capture until the mean of its cameras' upward directions is z."""
    found, (params, in_model_frame) = load(packed), read_gaussians(packed)
    assert found.up == (0, 0, 1)
    ups = torch.stack([camera.pose[:, 1] for camera in found.cameras]).mean(dim=0)
    assert torch.nn.functional.cosine_similarity(ups, torch.tensor(found.up), dim=0) > 0.99
    assert in_model_frame
    assert "features" not in params
    assert all(torch.equal(value, found.gaussians[name]) for name, value in params.items())


def test_a_run_is_cut_before_it_is_packed_or_exported(tiny, packed, tmp_path, capsys):
    whole, places = load(packed), load(tiny.folder).gaussians["means"][:, 0]
    middle = float(places.median())
    words = ["--crop", -1e3, -1e3, -1e3, middle, 1e3, 1e3, "--remove-floaters"]
    assert run("pack", tiny.folder, "-o", tmp_path / "a.sundae", *words) == 0
    found = load(tmp_path / "a.sundae")
    assert (found.head is None) == (whole.head is None)
    assert (found.meta["capture"], found.up) == (whole.meta["capture"], whole.up)
    assert float(found.gaussians["means"][:, 0].max()) < middle + 0.01
    inside = int((places <= middle).sum())
    assert 0.8 * inside < found.num_gaussians <= inside
    assert "PSNR" not in capsys.readouterr().out, "the photos show what is cut"
    assert run("export", tiny.folder, "-o", tmp_path / "a.ply", *words) == 0
    assert load(tmp_path / "a.ply").num_gaussians == found.num_gaussians


def test_levels_of_a_run_are_trained_from_the_cameras_of_its_photos(tiny, packed, tmp_path, monkeypatch):
    levels_of = Mock(side_effect=lambda scene, *_: [(scene, 30.0)])
    monkeypatch.setattr("sundae_ns.plugin.distill.levels_of", levels_of)
    assert run("export", tiny.folder, "-o", tmp_path / "a", "--lod", "--upright") == 0
    assert len(levels_of.call_args.args[1]) == len(load(packed).cameras)
    assert load(tmp_path / "a").up == pytest.approx((0, -1, 0), abs=1e-6)


def test_a_pack_without_its_capture_says_that_it_is_not_measured(tiny, tmp_path, capsys):
    assert run("pack", moved(tiny, tmp_path), "-o", tmp_path / "a.sundae", "--max-cameras", 0) == 0
    shown = capsys.readouterr()
    assert "PSNR" not in shown.out
    assert re.match(r"the quality is not measured: the capture .*elsewhere is missing; give its folder", shown.err)


def moved(tiny, folder):
    """The tiny run, whose capture is not where it was."""
    copied = shutil.copytree(tiny.folder, folder / "run")
    config = copied / "config.yml"
    config.write_text(config.read_text().replace(f"- {tiny.scene.name}\n", "- elsewhere\n"))
    return copied


def test_a_target_of_bytes_is_met_and_used(tiny, tmp_path, capsys):
    plain = figures(capsys, tiny.folder, "-o", tmp_path / "a.sundae")
    assert plain["bytes"] == (tmp_path / "a.sundae").stat().st_size
    bits = dict(plain["bits"])
    assert bits.pop("all") == pytest.approx(sum(bits.values()), abs=0.1)
    for share, *more in ((0.8,), (1.1,), (0.7, "--finetune", 2), (1.1, "--finetune", 2)):
        limit = int(share * plain["bytes"])
        file = tmp_path / f"{share} {len(more)}.sundae"
        found = figures(capsys, tiny.folder, "-o", file, "--max-mb", limit / 1e6, *more)
        assert 0.93 * limit < found["bytes"] <= limit, (share, more)
        assert not more or load(file).num_gaussians == load(tiny.folder).num_gaussians


def test_a_target_of_quality_is_met_and_states_it(tiny, tmp_path, capsys):
    found = figures(capsys, tiny.folder, "-o", tmp_path / "a.sundae", "--target-drop", 0.005)
    (before, after), (before_ssim, after_ssim) = found["psnr"], found["ssim"]
    assert before - 0.005 <= after < before + 0.05
    assert after_ssim == pytest.approx(before_ssim, abs=0.01)
    assert found["views"] == 3


def test_positions_are_rounded_once(tiny, scene, packed, tmp_path):
    """By the steps that the search finds, not by those that it begins with."""
    exact, errors = scene.gaussians["means"].double(), []
    assert run("pack", tiny.folder, "-o", tmp_path / "targeted.sundae", "--max-mb", 10) == 0
    for file in (packed, tmp_path / "targeted.sundae"):
        errors.append(float(torch.cdist(exact, read_scene(file).gaussians["means"].double()).amin(dim=1).max()))
    assert errors[1] < errors[0] / 4  # three bits more


class Stated:
    """Judges packs by a function of their options; a finished run has 30 dB.

    Bases other than those of a training lose 1 dB more.
    """

    before, cameras, all_cameras = Quality((30.0,), (0.9,)), 3, 3

    def __init__(self, drop, trained=None):
        self.drop, self.trained = drop, {} if trained is None else trained.gaussians

    def quality(self, _, codecs):
        pairs = [(codecs.gaussians[name], one) for name, one in self.trained.items() if isinstance(one, Transform)]
        same = all(isinstance(a, Transform) and torch.equal(a.basis, b.basis) for a, b in pairs)
        return Quality((30 - self.drop(codecs.config) - (0 if same else 1),), (0.9,))


def search(scene, drop, config=None):
    return Search(scene, config or PackConfig(), lambda: Stated(drop))


def search_tuned(tuned, drop):
    return Search(tuned.scene, tuned.codecs, lambda: Stated(drop, tuned.codecs))


@pytest.fixture(scope="module")
def tuned(scene):
    """A pack of a scene whose rows have moved since its codecs were fitted, as training moves them."""
    fitted, codecs = fit_scene(scene, FINETUNED)
    generator = torch.Generator().manual_seed(0)
    for name in codecs.gaussians:
        fitted.gaussians[name] += 0.3 * torch.randn(fitted.gaussians[name].shape, generator=generator)
    return Candidate(fitted, codecs, len(pack_bytes(fitted, codecs)[0]))


def test_the_search_uses_what_is_allowed(scene):
    """With a loss that grows with the steps, from below the default to above it."""
    with_steps = search(scene, lambda config: config.harmonics_step)
    for limit in (0.01, 0.1):
        assert 0.95 * limit < with_steps.better_than(limit).codecs.config.harmonics_step <= limit


def test_a_target_is_never_larger_than_a_default_that_meets_it(scene):
    """Even where finer steps happen to lose more."""
    by_chance = search(scene, lambda config: 0.06 if config.harmonics_step == 0.02 else 0.3)
    default, found = by_chance.default, by_chance.better_than(0.2)
    assert (found.bytes, by_chance.drop(found)) == (default.bytes, pytest.approx(0.06))
    with pytest.raises(ConfigError, match=r"the finest pack loses 0\.300 dB"):
        by_chance.better_than(0.01)


def test_a_target_begins_with_the_pack_of_the_fine_tune(tuned):
    """Not with grids, bases and steps that are fitted anew, which the training did not know."""
    search = search_tuned(tuned, lambda config: config.harmonics_step)
    assert search.default == tuned
    lost = FINETUNED.harmonics_step
    for limit, least in ((lost, 0.95 * lost), (2 * lost, 1.9 * lost), (0.5 * lost, 0.45 * lost)):
        found = search.better_than(limit)
        assert (found.bytes <= tuned.bytes) == (limit >= lost)
        assert least <= search.drop(found) <= limit
        assert found.codecs.blocks is tuned.codecs.blocks, "positions are rounded once"


@pytest.mark.parametrize(("drop", "helps"), [(0.01, True), (0.5, False)])
def test_a_fine_tune_that_does_not_help_is_left_out(scene, tuned, drop, helps):
    plain, other = search(scene, lambda config: config.harmonics_step), search_tuned(tuned, lambda _: drop)
    assert tuned.bytes < plain.default.bytes
    for searches in ([plain, other], [other, plain]):
        found = best_pack(searches, 0.02)
        assert (found.scene is tuned.scene) == helps
        assert found.bytes <= (tuned.bytes if helps else plain.default.bytes)
    if not helps:
        with pytest.raises(ConfigError, match=r"the finest pack loses 0\.500 dB"):
            best_pack([other, plain], 0.0001)


def test_coarser_steps_that_take_more_bytes_are_not_taken(tuned, monkeypatch):
    growing = lambda scene, codecs, power: Candidate(scene, codecs, round(100 + 10 * power))  # noqa: E731
    monkeypatch.setattr(tuned_packs, "pack_at", growing)
    assert search_tuned(tuned, lambda _: 0.0).better_than(0.1).bytes == 100


def test_targets_that_cannot_be_met(tiny, scene, tmp_path, capsys):
    """One line, and no file."""
    assert run("pack", tiny.folder, "-o", tmp_path / "a.sundae", "--max-mb", 0.001) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert re.search("a file without Gaussians has .* bytes; ask for more than 1,000", line)
    assert not list(tmp_path.iterdir())
    bare = figures(capsys, tiny.folder, "-o", tmp_path / "bare.sundae", "--no-head")["bytes"]
    for limit, code, beside in ((bare, 2, "none"), (bare + 36_500, 0, "[1-9][0-9]*")):  # the head takes some 37,700
        assert run("pack", tiny.folder, "-o", tmp_path / f"{code}.sundae", "--max-mb", limit / 1e6) == code
        said = f"the head takes [0-9,]+ of {limit:,} bytes; with --no-head about 298 Gaussians fit in place of {beside}"
        assert re.search(f"{said}\n$", capsys.readouterr().err)
    with pytest.raises(ConfigError, match=r"finest pack loses 0\.50* dB at [\d,]+ bytes; give a larger --target-drop"):
        search(scene, lambda _: 0.5, scaled(PackConfig(), COARSEST)).better_than(0.1)


def test_a_pack_is_worth_its_bytes_at_the_price_of_trials():
    assert tuned_packs.is_worth(30.0, 100, 30.0, 100)
    assert tuned_packs.is_worth(29.7, 50, 30.0, 100)
    assert not tuned_packs.is_worth(29.5, 50, 30.0, 100)  # half of the bytes are worth 0.4 dB


def test_steps_grow_together():
    finer, coarser = scaled(PackConfig(), -1.0), scaled(PackConfig(), 2.0)
    assert finer.harmonics_step == PackConfig().harmonics_step / 2
    assert coarser.opacity_step == 4 * PackConfig().opacity_step
    assert (finer.position_bits, coarser.position_bits) == (14, 11)
    for power in (-40.0, 40.0):
        scaled(PackConfig(), power).validate()


COARSE = PackConfig(position_bits=12, **dict(zip(STEPS, (0.3, 0.08, 0.9, 0.5, 1.0, 0.3, 0.1), strict=True)))


def test_training_makes_up_for_the_rounding(tiny, scene, tmp_path, monkeypatch):
    # Ten times the rates for a twentieth of the steps.
    monkeypatch.setattr(tuned_packs, "RATES", {name: 10 * rate for name, rate in tuned_packs.RATES.items()})
    seen, losses, train = [], [], RoundedTraining.step

    def watched(training, *arguments):
        result = train(training, *arguments)
        seen.append({name: value.detach().clone() for name, value in training._model.named_parameters()})
        return result

    before = contents(tiny.folder)
    with monkeypatch.context() as patch:
        patch.setattr(RoundedTraining, "step", watched)
        trained, codecs = finetune(tiny.folder, scene, COARSE, 60, progress=losses.append)
    assert contents(tiny.folder) == before
    assert len(losses) == len(seen) == 60
    # Images are made of rounded values: rounding them again changes nothing.
    for state in (seen[0], seen[1], seen[-1]):
        shown = codecs.rounded({name: state[f"gauss_params.{name}"] for name in codecs.gaussians})
        assert all(torch.equal(shown[name], state[f"gauss_params.{name}"]) for name in ("scales", "features_dc"))
        for name in trained.head:
            value = state[f"networks.head.{name}"]
            assert torch.equal(codecs.head.rounded(name, value), value)
    assert not torch.equal(seen[0]["gauss_params.scales"], seen[-1]["gauss_params.scales"])
    assert trained.meta["source"] == {**scene.meta["source"], "finetuned": 60}
    # The positions are those of a pack without it, and everything else has moved.
    fitted, plain_codecs = fit_scene(scene, COARSE)
    assert torch.equal(trained.gaussians["means"], fitted.gaussians["means"])
    for name in codecs.gaussians:
        assert not torch.equal(trained.gaussians[name], fitted.gaussians[name]), name
    for name, value in trained.head.items():
        assert not torch.equal(value, fitted.head[name]), name

    # As many steps without coarse rounding in the loop.
    blind, _ = finetune(tiny.folder, scene, PackConfig(), 60)
    packs = {"tuned": (trained, codecs), "plain": (fitted, plain_codecs), "blind": fit_scene(blind, COARSE)}
    for name, made in packs.items():
        write_fitted(tmp_path / name, *made)
    found, shown = read_scene(tmp_path / "tuned"), codecs.rounded(trained.gaussians)
    assert all(torch.equal(found.gaussians[name], shown[name]) for name in codecs.gaussians)
    tuned, plain, surprised = (quality(load_model(tmp_path / name, data=tiny.scene)) for name in packs)
    assert tuned > plain + 0.1
    assert tuned > surprised + 0.01
    assert (tmp_path / "tuned").stat().st_size < 1.05 * (tmp_path / "plain").stat().st_size


def test_the_command_fine_tunes_a_run_whose_capture_has_moved(tiny, tmp_path, capsys):
    folder, file = moved(tiny, tmp_path), tmp_path / "a.sundae"
    words = ["pack", folder, "-o", file, "--finetune", 3]
    assert run(*words) == 2
    assert "elsewhere does not exist" in capsys.readouterr().err
    assert run(*words, "--data", tiny.scene) == 0
    assert f"{file}: " in capsys.readouterr().out
    meta = read_header(file).meta
    assert meta["source"]["finetuned"] == 3
    stored = meta["attributes"]
    _, codecs = fit_scene(contents_of(load_run(folder, data=tiny.scene)), FINETUNED)
    for name in codecs.gaussians:
        assert stored[name]["step"] == codecs.gaussians[name].step, name
    assert stored["scales"]["step"] == FINETUNED.scale_step
    assert FINETUNED.feature_step <= stored["features"]["step"] < FINETUNED.feature_step / 0.02**0.5


def test_a_fine_tune_that_loses_says_so(tiny, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(tuned_packs, "is_worth", lambda *_: False)
    assert run("pack", tiny.folder, "-o", tmp_path / "a.sundae", "--finetune", 1) == 0
    lost = capsys.readouterr()
    assert re.search(r"PSNR \d+\.\d\d -> \d+\.\d\d dB, SSIM 0", lost.out)
    assert re.search(r"the fine-tune of 1 steps loses -?\d\.\d\d dB; a pack without it has [\d,]+ bytes", lost.err)


def test_an_interrupt_leaves_nothing(tiny, tmp_path, monkeypatch):
    def interrupted(step, steps):
        if step == 2:
            raise KeyboardInterrupt
        return 1.0

    monkeypatch.setattr(tuned_packs, "rate_factor", interrupted)
    before = contents(tiny.folder)
    for text in ("", "the one of yesterday"):
        if text:
            (tmp_path / "a.sundae").write_text(text)
        with pytest.raises(KeyboardInterrupt):
            pack(tiny.folder, tmp_path / "a.sundae", advanced=PackDetails(finetune=5, overwrite=bool(text)))
        assert [path.read_text() for path in tmp_path.iterdir()] == ([text] if text else [])
    assert contents(tiny.folder) == before


def test_full_memory_is_one_line(tiny, scene, monkeypatch):
    text = "CUDA out of memory. Tried to allocate 300.00 MiB."
    monkeypatch.setattr(torch.autograd, "grad", Mock(side_effect=torch.cuda.OutOfMemoryError(text)))
    count = len(scene.gaussians["means"])
    with pytest.raises(MemoryExhaustedError, match=rf"cannot allocate 300\.00 MiB more with {count:,} Gaussians"):
        finetune(tiny.folder, scene, PackConfig(), 1)


def test_a_run_of_splatfacto(scene, stock_run, tmp_path):
    rest = 0.1 * torch.randn(len(scene.gaussians["means"]), 8, 3)
    rest[::2] = 0  # these colours stay view-independent
    stock_run(tmp_path, {**scene.gaussians, "features_rest": rest}, 29999)
    stock = contents_of(load_run(tmp_path, max_cameras=0))
    trained, codecs = finetune(tmp_path, stock, PackConfig(), 3)
    assert codecs.head is None
    assert trained.head == {}
    fitted, _ = fit_scene(stock)
    flat = [~made.gaussians["features_rest"].flatten(1).any(dim=1) for made in (fitted, trained)]
    assert 0 < int(flat[0].sum()) < len(rest)
    assert torch.equal(*flat)
    assert not torch.equal(trained.gaussians["features_rest"], fitted.gaussians["features_rest"])


def test_runs_that_cannot_be_fine_tuned(tiny, tmp_path):
    (tmp_path / "nerfstudio_models").mkdir()
    shutil.copy(tiny.config, tmp_path)
    shutil.copy(tiny.checkpoint(30), tmp_path / "nerfstudio_models")
    early = contents_of(load_run(tmp_path))
    with pytest.raises(CheckpointError, match="was saved during densification"):
        finetune(tmp_path, early, PackConfig(), 3)
    with pytest.raises(ConfigError, match="changes nothing"):
        finetune(tmp_path, early, PackConfig(), 0)


def test_rates_rise_and_fall_to_nothing():
    for steps in (1, 2, 10, 1000):
        factors = [rate_factor(step, steps) for step in range(steps)]
        assert all(0 < factor <= 1 for factor in factors)
        top = factors.index(max(factors))
        assert factors == sorted(factors[:top]) + sorted(factors[top:], reverse=True)
    assert factors[-1] < 1e-4 < factors[0] < 0.05


def test_gradients_follow_a_quaternion_to_its_negative():
    exact = torch.nn.functional.normalize(torch.tensor([[-1.0, 0.2, 0.3, 0.1], [1.0, 0.2, 0.3, 0.1]]))
    training = SimpleNamespace(exact={"quats": exact}, rounded={"quats": exact * torch.tensor([[-1.0], [1.0]])})
    RoundedTraining.set_gradient(training, "quats", torch.ones(2, 4), None)
    assert torch.equal(exact.grad, torch.tensor([[-1.0], [1.0]]).expand(2, 4))


@pytest.mark.gpu
def test_replayed_steps_train_the_same_scene(tiny, scene, monkeypatch):
    """One training kernel by kernel, one by recordings: the same losses up to the order of sums."""
    steps, train = [], RoundedTraining.step

    def watched(training, *arguments):
        steps.append(training)
        return train(training, *arguments)

    def losses():
        found = []
        finetune(tiny.folder, scene, COARSE, 30, progress=lambda loss: found.append(loss.item()))
        return found

    monkeypatch.setattr(RoundedTraining, "step", watched)
    recorded = losses()
    assert len(steps) == 30
    assert steps[-1]._can_record
    assert steps[-1]._recordings._recordings
    monkeypatch.setattr(RoundedTraining, "step", lambda training, *arguments: training._run(*arguments, None))
    assert recorded == pytest.approx(losses(), rel=0.05)
