"""``sundae pack`` on a finished run, and what reads its file: measurements, and a warm start."""

import io
import re
from contextlib import redirect_stdout
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import pytest
import torch

from sundae_ns.cli import main
from sundae_ns.core.metrics import psnr
from sundae_ns.io.formats import read_gaussians
from sundae_ns.plugin.finished_runs import load_model
from sundae_ns.scene.load_save import load


class Packed(NamedTuple):
    file: Path
    output: str


@pytest.fixture(scope="module")
def packed(tiny, tmp_path_factory):
    file = tmp_path_factory.mktemp("packed") / "tiny.sundae"
    with redirect_stdout(io.StringIO()) as output, pytest.raises(SystemExit, match="0"):
        main(["pack", str(tiny.folder), "-o", str(file)])
    return Packed(file, output.getvalue())


def test_the_report_counts_every_byte(packed):
    table, _, quality = packed.output.partition("bits per Gaussian")[2].partition("\nPSNR ")
    assert re.fullmatch(
        r"\d+\.\d\d -> \d+\.\d\d dB, SSIM 0\.\d{4} -> 0\.\d{4}, before and after, on 3 of 3 test views\n", quality
    )
    rows = {words[0]: int(words[1].replace(",", "")) for words in map(str.split, table.strip().splitlines())}
    size = packed.file.stat().st_size
    assert rows.pop("all") == size
    assert sum(rows.values()) == size
    assert {"means", "quats", "scales", "features", "head", "cameras", "header"} <= set(rows)


def test_the_up_axis_is_that_of_the_capture(packed):
    """nerfstudio turns a capture until the mean of its cameras' upward directions is z."""
    found = load(packed.file)
    assert found.up == (0, 0, 1)
    ups = torch.stack([camera.pose[:, 1] for camera in found.cameras]).mean(dim=0)
    assert torch.nn.functional.cosine_similarity(ups, torch.tensor(found.up), dim=0) > 0.99


def test_a_run_is_cut_before_it_is_packed_or_exported(tiny, packed, tmp_path, capsys):
    whole = load(packed.file)
    places = load(tiny.folder).gaussians["means"][:, 0]
    middle = float(places.median())
    box = [-1e3, -1e3, -1e3, middle, 1e3, 1e3]
    for words in (["--crop", *box], ["--remove-floaters"]):
        cut = tmp_path / "a.sundae"
        with pytest.raises(SystemExit, match="0"):
            main(["pack", str(tiny.folder), "-o", str(cut), "--overwrite", *map(str, words)])
        found, said = load(cut), capsys.readouterr()
        assert (found.head is None) == (whole.head is None)
        assert found.meta["capture"] == whole.meta["capture"]
        assert found.up == whole.up
        if words[0] == "--crop":
            assert float(found.gaussians["means"][:, 0].max()) < middle + 0.01
            assert found.num_gaussians == int((places <= middle).sum())
            assert "PSNR" not in said.out, "the photos show what is cut"
        else:
            before, after = map(float, re.findall(r"PSNR ([\d.]+) -> ([\d.]+) dB", said.out)[0])
            assert after > before - 0.15
            assert found.num_gaussians <= whole.num_gaussians
        with pytest.raises(SystemExit, match="0"):
            main(["export", str(tiny.folder), "-o", str(tmp_path / "a.ply"), "--overwrite", *map(str, words)])
        assert load(tmp_path / "a.ply").num_gaussians == found.num_gaussians


def test_a_packed_scene_is_measured_on_its_capture(tiny, packed):
    before, after = load_model(tiny.config), load_model(packed.file, data=tiny.scene)
    for name in ("rgb", "base_rgb"):
        values = [
            fmean(
                float(psnr(run.model.get_outputs_for_camera(camera)[name], truth))
                for camera, truth in zip(run.cameras, run.truths, strict=True)
            )
            for run in (before, after)
        ]
        assert 0 < abs(values[0] - values[1]) < 0.15
    assert torch.equal(before.cameras[1].camera_to_worlds, after.cameras[1].camera_to_worlds)


def test_a_warm_start_reads_a_packed_scene(packed):
    (params, in_model_frame), truth = read_gaussians(packed.file), load(packed.file)
    assert in_model_frame
    assert "features" not in params
    assert all(torch.equal(value, truth.gaussians[name]) for name, value in params.items())
