"""The programs in ``examples/`` run, and show what they say."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from packed_scenes import KINDS, write_kind
from PIL import Image

import sundae_ns as sn

EXAMPLES = Path(__file__).parents[1] / "examples"


def run(name: str, *words: object) -> str:
    command = [sys.executable, str(EXAMPLES / name), *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball of smooth colours."""
    generator = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(600, 3, generator=generator), dim=1)
    scene = sn.Scene.from_points(points, 0.5 + 0.4 * points)
    scene.field["opacities"] += 4
    path = tmp_path_factory.mktemp("examples") / "cloud.ply"
    sn.save(scene, path)
    return path


def test_every_example_is_tested() -> None:
    assert {path.name for path in EXAMPLES.glob("*.py")} == {"plot_curve.py", "prune_ply.py", "render_packed.py"}


def test_prune_ply(cloud: Path, tmp_path: Path) -> None:
    text = run("prune_ply.py", cloud, tmp_path / "a.spz", "--keep", 0.5, "--views", 8)
    assert "300 of 600 primitives" in text
    assert float(re.findall(r"PSNR ([\d.]+) dB", text)[0]) > 20
    assert sn.load(tmp_path / "a.spz").num_primitives == 300


def test_render_packed(tmp_path: Path) -> None:
    packed = write_kind(tmp_path / "a.sundae", KINDS["residual"])
    assert "tiny head" in run("render_packed.py", packed, tmp_path / "a.png", "--view", 1)
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.size == (3 * 50, 37)


def test_plot_curve(cloud: Path, tmp_path: Path) -> None:
    text = run("plot_curve.py", cloud, tmp_path / "a.png", "--views", 4)
    quality = [float(value) for value in re.findall(r"merged: [\d,]+ primitives, ([\d.]+) dB", text)]
    assert len(quality) == 10
    assert quality[4] > quality[0]
    assert Image.open(tmp_path / "a.png").size == (750, 525)
