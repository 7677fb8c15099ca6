"""``sundae pack`` and ``sundae unpack`` on a finished run, and nerfstudio's own commands on what comes out."""

from __future__ import annotations

import io
import json
import re
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer_elements import ViewerElement
from PIL import Image

from sundae_ns.api.opening import load
from sundae_ns.cli import main
from sundae_ns.evaluation import psnr
from sundae_ns.scenes.opening import open_scene


class Packed(NamedTuple):
    file: Path
    output: str
    config: Path
    """Of the run that was unpacked beside its capture."""
    blind: Path
    """Of the one that was unpacked without."""


@pytest.fixture(scope="module")
def packed(tiny: Any, tmp_path_factory: pytest.TempPathFactory) -> Packed:
    folder = tmp_path_factory.mktemp("packed")
    file = folder / "tiny.sundae"
    with redirect_stdout(io.StringIO()) as output, pytest.raises(SystemExit, match="0"):
        main(["pack", str(tiny.folder), "-o", str(file)])
    with pytest.raises(SystemExit, match="0"):
        main(["unpack", str(file), "-o", str(folder / "runs"), "--name", "blind"])
    with redirect_stderr(io.StringIO()) as errors, pytest.raises(SystemExit, match="0"):
        main(["unpack", str(file), "-o", str(folder / "runs"), "--data", str(tiny.scene)])
    assert errors.getvalue() == ""
    config, blind = (folder / "runs" / name / "sundae" / "unpacked" / "config.yml" for name in ("tiny", "blind"))
    return Packed(file, output.getvalue(), config, blind)


def test_the_report_counts_every_byte(packed: Packed) -> None:
    table, _, quality = packed.output.partition("bits per primitive")[2].partition("\nPSNR ")
    assert re.fullmatch(
        r"\d+\.\d\d -> \d+\.\d\d dB, SSIM 0\.\d{4} -> 0\.\d{4}, before and after, on 3 of 3 test views\n", quality
    )
    rows = {words[0]: int(words[1].replace(",", "")) for words in map(str.split, table.strip().splitlines())}
    size = packed.file.stat().st_size
    assert rows.pop("all") == size
    assert sum(rows.values()) == size
    assert {"means", "quats", "scales", "features", "head", "cameras", "header"} <= set(rows)


def test_the_up_axis_is_that_of_the_capture(packed: Packed) -> None:
    """nerfstudio turns a capture until the mean of its cameras' upward directions is z."""
    found = load(packed.file)
    assert found.up == (0, 0, 1)
    ups = torch.stack([view.pose[:, 1] for view in found.views]).mean(dim=0)
    assert torch.nn.functional.cosine_similarity(ups, torch.tensor(found.up), dim=0) > 0.99
    assert load(packed.blind).up == load(packed.config).up == found.up


def test_a_run_is_cut_before_it_is_packed_or_exported(
    tiny: Any, packed: Packed, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = load(packed.file)
    places = load(tiny.folder).field["means"][:, 0]
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
            assert float(found.field["means"][:, 0].max()) < middle + 0.01
            assert found.num_primitives == int((places <= middle).sum())
            assert "PSNR" not in said.out, "the photos show what is cut"
        else:
            before, after = map(float, re.findall(r"PSNR ([\d.]+) -> ([\d.]+) dB", said.out)[0])
            assert after > before - 0.15
            assert found.num_primitives <= whole.num_primitives
        with pytest.raises(SystemExit, match="0"):
            main(["export", str(tiny.folder), "-o", str(tmp_path / "a.ply"), "--overwrite", *map(str, words)])
        assert load(tmp_path / "a.ply").num_primitives == found.num_primitives


@pytest.mark.filterwarnings("error::UserWarning")
def test_ns_eval_finds_the_same_quality(tiny: Any, packed: Packed, call_here: Any, tmp_path: Path) -> None:
    said = call_here("ns-eval", "--load-config", packed.config, "--output-path", tmp_path / "out.json")
    assert "sparse point cloud" not in said, "the field is finished, wherever it started"
    after = json.loads((tmp_path / "out.json").read_text())["results"]
    run = open_scene(tiny.config)
    assert after["gaussian_count"] == run.model.num_points
    with torch.no_grad():
        pictures = [run.model.get_outputs_for_camera(camera) for camera in run.cameras]
    for name, key in (("rgb", "psnr"), ("base_rgb", "psnr_base")):
        values = [float(psnr(picture[name], truth)) for picture, truth in zip(pictures, run.truths, strict=True)]
        assert 0 < abs(after[key] - sum(values) / len(values)) < 0.15


def test_ns_render_needs_no_capture(packed: Packed, call_here: Any, tmp_path: Path) -> None:
    call_here(
        *("ns-render", "interpolate", "--load-config", packed.blind, "--output-path", tmp_path),
        *("--output-format", "images", "--image-format", "png", "--interpolation-steps", 1, "--pose-source", "train"),
    )
    frames = [np.asarray(Image.open(path)) for path in sorted(tmp_path.glob("*.png"))]
    assert len(frames) > 5
    assert all(frame.shape == (48, 48, 3) and frame.std() > 5 for frame in frames)


@pytest.mark.parametrize("command", ["report", "bench frame"])
def test_grey_is_no_truth(
    tiny: Any, packed: Packed, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    run, out = packed.blind.parent, str(tmp_path / "out")
    words = ["report", str(run), "-o", out] if command == "report" else ["bench", "frame", str(run)]
    # Naming a capture makes no run of it: the cameras of the two do not agree.
    for more in ([], ["--data", str(tiny.scene)] if command == "report" else []):
        with pytest.raises(SystemExit, match="2"):
            main([*words, *more])
        (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("sundae: ")]
        assert f"{run} was unpacked without its capture" in line


def test_the_viewer_shows_a_run_without_its_capture(packed: Packed) -> None:
    blind, whole = (eval_setup(config, test_mode="test")[1] for config in (packed.blind, packed.config))
    # The viewer looks at every attribute of everything, pictures of the test views included.
    names = [name for name, _ in parse_object(blind, ViewerElement, "Custom Elements")]
    assert any("compensate" in name for name in names)
    seen = blind.datamanager.train_dataset
    assert (seen[0]["image"] * 255).byte().shape == (48, 48, 3)
    camera = seen.cameras[0:1]
    assert torch.equal(camera.camera_to_worlds, whole.datamanager.train_dataset.cameras[0:1].camera_to_worlds)
    pictures = [run.model.get_outputs_for_camera(camera)["rgb"] for run in (blind, whole)]
    assert torch.equal(*pictures)
