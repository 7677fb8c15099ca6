"""Captures of few views."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from nerfstudio.data.utils import colmap_parsing_utils as colmap
from PIL import Image

from harness import few_views

SIZE, PHOTOS = 16, 10


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Ten photos; point k is seen by photos k and k + 1 alone."""
    none = np.zeros(0, int)
    images = {
        k + 1: colmap.Image(k + 1, np.array([1.0, 0, 0, 0]), np.array([0.1 * k, 0, 4]), 1, f"{k:02}.png", none, none)
        for k in range(PHOTOS)
    }
    points = {
        k: colmap.Point3D(k, np.array([k, 0.0, 0]), np.full(3, 9), 0.5, np.array([k, k + 1]), np.array([0, 0]))
        for k in range(1, PHOTOS)
    }
    cameras = {1: colmap.Camera(1, "PINHOLE", SIZE, SIZE, np.array([20.0, 20, 8, 8]))}
    (tmp_path / "all/sparse/0").mkdir(parents=True)
    (tmp_path / "all/images").mkdir()
    colmap.write_model(cameras, images, points, str(tmp_path / "all/sparse/0"), ext=".bin")
    for k in range(PHOTOS):
        Image.new("RGB", (SIZE, SIZE), (k, k, k)).save(tmp_path / f"all/images/{k:02}.png")
    return tmp_path / "all"


def test_a_capture_of_few_views_knows_what_they_see_and_nothing_else(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "few"
    monkeypatch.setattr(sys, "argv", ["few_views.py", str(capture), str(out), "-n", "8", "--tests", "1"])
    few_views.main()
    _, images, points = colmap.read_model(str(out / "sparse/0"), ext=".bin")
    names = sorted(image.name for image in images.values())
    left_out = {f"{k:02}" for k in range(PHOTOS)} - {name.split("_")[1][:2] for name in names if "train" in name}
    assert sum(name.startswith("train_") for name in names) == 8
    assert sum(name.startswith("eval_") for name in names) == 1
    assert {path.name for path in (out / "images").iterdir()} == set(names)
    # Photo k has the identifier k + 1, and point k needs the photos k and k + 1.
    missing = {int(name) + 1 for name in left_out}
    assert set(points) == {k for k in range(1, PHOTOS) if not {k, k + 1} & missing}
    assert 0 < len(points) < PHOTOS - 1
