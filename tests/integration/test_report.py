"""Finished runs opened and measured, and ``sundae compare`` of the tiny run and of stock splatfacto."""

import base64
import copy
import csv
import dataclasses
import json
import os
import re
import shutil
from functools import partial
from io import BytesIO

import numpy as np
import pytest
import torch
import yaml
from command_line import run
from csv_rows import read_rows
from PIL import Image

import sundae_ns as sn
from sundae_ns.core.errors import DataError
from sundae_ns.io import checkpoint
from sundae_ns.io.pack.packed_scene import fit_scene, write_fitted
from sundae_ns.plugin import finished_runs
from sundae_ns.plugin.finished_runs import load_model, load_run
from sundae_ns.report.measure import COLUMNS, Subject, measure
from sundae_ns.scene.packing import contents_of


@pytest.fixture(scope="module")
def stock(tiny, stock_run, tmp_path_factory):
    """A run of splatfacto with the Gaussians of the tiny run."""
    state = torch.load(tiny.checkpoint(tiny.steps - 1), map_location="cpu")["pipeline"]
    gaussians = {key.rpartition(".")[2]: value for key, value in state.items() if "gauss_params" in key}
    rest = gaussians["features_rest"]
    gaussians["features_rest"] = torch.cat([rest, rest.new_zeros(len(rest), 15 - rest.shape[1], 3)], 1)
    return stock_run(tmp_path_factory.mktemp("stock") / "stock" / "splatfacto" / "now", gaussians, 6999)


@pytest.fixture(scope="module")
def report(tiny, stock, tmp_path_factory):
    out = tmp_path_factory.mktemp("report")
    assert run("compare", tiny.folder, stock / "config.yml", "-o", out, "--repeats", 1) == 0
    return out


@pytest.fixture
def opened(tiny):
    return load_model(tiny.config)


def test_a_run_opens_while_its_training_replaces_the_checkpoint(tiny, tmp_path, monkeypatch):
    copied = shutil.copytree(tiny.folder, tmp_path / "run")
    newest = checkpoint.newest_whole(copied)[0]

    def unlink():
        newest.unlink(missing_ok=True)
        return torch.device("cpu")

    monkeypatch.setattr(finished_runs, "fastest_device", unlink)
    assert load_model(copied).steps == tiny.steps  # it reads the capture for seconds after it has found the checkpoint


def test_a_capture_that_has_moved_is_found_or_named(tiny, tmp_path):
    """Found where it stands as before as seen from the run, and otherwise by --data."""
    root = os.path.commonpath([tiny.scene, tiny.folder])
    run = shutil.copytree(tiny.folder, tmp_path / tiny.folder.relative_to(root))
    capture = tmp_path / tiny.scene.relative_to(root)
    config, lost = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader), tmp_path / "gone"
    config.output_dir = lost / config.output_dir.relative_to(root)
    config.data = config.pipeline.datamanager.data = lost / tiny.scene.relative_to(root)
    (run / "config.yml").write_text(yaml.dump(config))
    with pytest.raises(DataError, match=f"the capture {lost}.* is missing; give its folder with --data"):
        load_model(run)
    assert load_model(run, data=tiny.scene).capture == tiny.scene
    shutil.copytree(tiny.scene, capture)
    assert load_model(run).capture == capture
    stated = shutil.copytree(capture, tmp_path / "garden/capture") / "transforms.json"  # as sundae run writes it
    stated.write_text(stated.read_text().replace('"file_path"', '"original": "IMG 1.HEIC", "file_path"'))
    subject = Subject.of_run(load_model(run, data=stated.parent))
    assert ({*subject.names}, subject.facts["scene"]) == ({"IMG 1.HEIC"}, "garden")


def test_figures_of_a_run(opened):
    model, cameras, truths = opened.model, opened.cameras, opened.truths
    assert [truth.shape[:2] for truth in truths] == [(int(c.height), int(c.width)) for c in cameras]
    assert all(0 <= truth.min() <= truth.max() <= 1 for truth in truths)
    subject = Subject.of_run(opened)
    figures = measure(subject, warmup=0, repeats=1)
    assert min(figures.full.ms, figures.base.ms, figures.ms_head) > 0
    assert figures.bytes_primitives == 4 * sum(value.numel() for value in model.gauss_params.values())
    assert figures.bytes_head == sum(value.numel() * value.element_size() for value in model.head.parameters())
    assert not torch.equal(subject.image(0), subject.image(0, head=False))
    # Before the head is enabled there is none to time, and it has no bytes.
    model.state.head_starts_at = 10**9
    figures = measure(Subject.of_run(opened), warmup=0, repeats=1)
    assert (figures.bytes_head, figures.ms_head) == (0, 0)
    assert figures.bytes_primitives == figures.full.bytes


@torch.no_grad()
def test_the_head_is_timed_at_the_size_at_which_it_runs(opened):
    model, whole, seen = opened.model, tuple(opened.truths[0].shape[:2]), []
    model.head.register_forward_pre_hook(lambda _, arguments: seen.append(tuple(arguments[0].shape[:2])))

    def sizes_seen(render):
        seen.clear()
        render()
        return set(seen)

    # Frames of other scales are corrected at the trained one, thumbnails not at all.
    for factor, expected in ((1.0, {whole}), (0.875, {whole}), (0.5, {whole}), (2.0, {whole}), (0.25, set())):
        camera = copy.deepcopy(opened.cameras[0])
        camera.rescale_output_resolution(factor)
        assert sizes_seen(partial(model.get_outputs_for_camera, camera)) == expected
        subject = Subject.of_run(dataclasses.replace(opened, cameras=[camera], truths=opened.truths[:1]))
        assert sizes_seen(partial(subject.image, 0)) == expected
        assert subject.head_ms(0, lambda render: len(sizes_seen(render))) == len(expected)


def test_rows_are_of_the_runs(report, tiny, opened):
    assert {path.name for path in report.iterdir()} == {f"report.{kind}" for kind in ("json", "csv", "md", "html")}
    with open(report / "report.csv", newline="") as file:
        assert tuple(next(csv.reader(file))) == COLUMNS
    ours, theirs = read_rows(report / "report.csv")
    gaussians = opened.model.gauss_params
    assert (ours.scene, ours.method, ours.steps) == ("scene", "sundae-tiny", tiny.steps)
    assert ours.keep_ratio == pytest.approx(tiny.keep_ratio, abs=0.01)
    assert (theirs.scene, theirs.method, theirs.steps, theirs.keep_ratio) == ("scene", "splatfacto", 7000, 1.0)
    assert ours.primitives == theirs.primitives
    # The same Gaussians without a head give the same images, whichever method the configuration names.
    assert ours.psnr_base == theirs.psnr == theirs.psnr_base
    assert ours.psnr != ours.psnr_base
    assert min(ours.ms_frame, ours.ms_splat, ours.ms_head, theirs.ms_frame) > 0
    assert ours.bytes_head > 0 == theirs.bytes_head
    assert ours.command.startswith("sundae compare ")
    own, stock = (row["configurations"] for row in json.loads((report / "report.json").read_text()))
    assert [[way["name"] for way in ways] for ways in (own, stock)] == [["head on", "head off"], ["head off"]]
    assert own[1]["bytes"] == sum(4 * value.numel() for name, value in gaussians.items() if name != "features")


def test_the_page_shows_the_views_with_their_figures(report, tiny):
    text = (report / "report.html").read_text(encoding="utf-8")
    rows = json.loads((report / "report.json").read_text())
    cards = re.findall("<article.*?</article>", text, re.DOTALL)
    views = [(row, index) for row in rows for index in range(3)]
    photographs = sorted((tiny.scene / "images").iterdir())
    for card, (row, index) in zip(cards, views, strict=True):
        for way in row["configurations"]:
            found = way["views"][index]
            assert f"PSNR {found['psnr']:.2f} dB, SSIM {found['ssim']:.4f}" in card
        photo = photographs[(2, 7, 12)[index]]
        assert f">{photo.name}</h4>" in card
        data = [base64.b64decode(each) for each in re.findall(r'src="data:image/\w+;base64,([^"]+)"', card)]
        assert len(data) == 2 + len(row["configurations"])
        shown, rendering, *_ = (np.asarray(Image.open(BytesIO(each)), dtype=float) for each in data)
        truth = np.asarray(Image.open(photo), dtype=float)
        assert np.array_equal(shown, truth)
        psnr = 20 * np.log10(255 / np.sqrt(((rendering - truth) ** 2).mean()))
        assert psnr == pytest.approx(row["configurations"][0]["views"][index]["psnr"], abs=0.01)
    assert len({*re.findall('<option value="(v[0-9-]+)">', text)}) == len(views)  # each stands beside the other run's


def one_line(capsys):
    (line,) = [line for line in capsys.readouterr().err.strip().splitlines() if line.startswith("sundae: ")]
    return line


def test_a_run_that_cannot_be_opened_does_not_lose_the_others(tiny, tmp_path, capsys):
    paths = (tmp_path, tiny.folder, tiny.scene)
    assert run("compare", *paths, "-o", tmp_path / "out", "--repeats", 0) == 1
    assert len(read_rows(tmp_path / "out" / "report.csv")) == 1
    said, page = " ".join(capsys.readouterr().out.split()), (tmp_path / "out" / "report.md").read_text()
    assert said.count("is no run") == page.count("is no run") == 2, page
    assert run("compare", tiny.folder, "-o", tmp_path / "other", "--repeats", -1) == 2
    assert "repeats is -1; give at least 0" in one_line(capsys)


def test_a_packed_scene_counts_the_bytes_of_its_file(report, tiny, tmp_path, capsys):
    packed = tmp_path / "tiny.sundae"
    write_fitted(packed, *fit_scene(contents_of(load_run(tiny.folder))))
    words = ("compare", packed, "-o", tmp_path / "out", "--repeats", 0)
    assert run(*words) == 2
    assert "give another, --formats, or --data with a capture" in one_line(capsys)
    assert run(*words, "--data", tiny.scene) == 0
    (row,), before = read_rows(tmp_path / "out" / "report.csv"), read_rows(report / "report.csv")[0]
    assert row.ms_frame is row.ms_splat is None, "nothing was timed"
    assert row.bytes_total == packed.stat().st_size < before.bytes_total
    assert (row.method, row.variant, row.steps) == ("sundae-tiny", "tiny.sundae", tiny.steps)
    assert (row.primitives, row.seed, row.keep_ratio) == (before.primitives, None, None)
    assert row.psnr == pytest.approx(before.psnr, abs=0.15)
    assert row.psnr_base == pytest.approx(before.psnr_base, abs=0.15)


def test_files_of_any_program_are_compared_with_the_photos(tiny, report, tmp_path, capsys):
    """A .ply says that its coordinates are the model's; a .spz does not, and those that fit the photos are taken."""
    scene = sn.load(tiny.folder)
    files = [tmp_path / "a.ply", tmp_path / "a.spz", tmp_path / "capture.ply"]
    sn.save(scene, files[0])
    sn.save(scene, files[1])
    rows, scale = torch.tensor(scene.meta["frame"]["transform"])[:3], scene.meta["frame"]["scale"]
    back = sn.transform(scene, rows[:, :3].T, 1 / scale, -(rows[:, :3].T @ rows[:, 3]))
    sn.save(dataclasses.replace(back, in_model_frame=False, head=None), files[2])
    base = read_rows(report / "report.csv")[0].psnr_base
    for words in ((tiny.folder, *files), (*files, "--data", tiny.scene)):
        assert run("compare", *words, "-o", tmp_path / "out", "--overwrite", "--repeats", 0) == 0
        found = [row.psnr_base for row in read_rows(tmp_path / "out" / "report.csv")[-3:]]
        # Without a run, what no Gaussian covers is black.
        assert found == pytest.approx([base] * 3, abs=0.1 if tiny.folder in words else 0.6)
        assert max(found) - min(found) < 0.1
