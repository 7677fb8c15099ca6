"""benchmarks/bench_page.py --dawn: what it times, and the rows that it gives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from chromium import bench_page, needs_packages
from packed_scenes import FOCAL, HEIGHT, KINDS, WIDTH, write_kind

from sundae_ns.storage.pack import read_scene

SPLAT = {"project", "sort_depths", "list_tiles", "sort_tiles", "blend"}
HEAD = {"head_fold", "head_convolve", "head_resize", "head_project"}
LEAST = 55.0
"""Lowest PSNR of an image against Python's, whose rounding gives 58.9 dB; the worst is 58.7."""


@pytest.mark.parametrize(("width", "height", "left", "top"), [(100, 50, 0, 6), (25, 37, 12.5, 0), (50, 37, 0, 0)])
def test_a_cropped_camera_shows_the_middle_of_its_image(
    width: int, height: int, left: float, top: float, tmp_path: Path
) -> None:
    scene = read_scene(write_kind(tmp_path / "a.sundae", KINDS["residual"]))
    small = bench_page.cropped(scene, width, height)
    assert small.cameras["sizes"].tolist() == [[width, height]] * 2
    share = width / (WIDTH - 2 * left)
    corner = torch.tensor([left, top])
    for whole, crop in zip(scene.cameras["intrinsics"], small.cameras["intrinsics"], strict=True):
        # Rays through the same points of both images.
        for point in (torch.zeros(2), torch.tensor([7.0, 3.0])):
            ray = (corner + point / share - whole[2:]) / whole[:2]
            torch.testing.assert_close((point - crop[2:]) / crop[:2], ray)
    assert small.meta["model"]["trained_focal"] == pytest.approx([share * FOCAL] * 2)
    assert scene.meta["model"]["trained_focal"] == [FOCAL] * 2


@needs_packages
@pytest.mark.browser
@pytest.mark.parametrize("as_trained", [False, True])
def test_a_row_for_each_size_with_the_head_off_and_on(as_trained: bool, tmp_path: Path) -> None:
    packed = write_kind(tmp_path / "a.sundae", KINDS["trained at a smaller scale"])
    sizes = [(2 * WIDTH, 2 * HEIGHT), (64, 200)]  # every second row of the taller images is compared
    try:
        rows: list[dict[str, Any]] = bench_page.timed(packed, sizes, 4, as_trained=as_trained)
    except SystemExit as error:
        if "no adapter" in str(error):
            pytest.skip(str(error))
        raise
    assert [(row["size"], row["head"]) for row in rows] == [
        (f"{width}x{height}", head) for width, height in sizes for head in (False, True)
    ]
    for row in rows:
        assert row["adapter"]
        assert row["primitives"] == len(read_scene(packed).field["means"])
        assert row["frames"] == 4
        assert row["undrawn"] == 0
        assert row["ms_first"] > 0
        assert len(row["psnr"]) == row["cameras"] == len(row["ms_frame_by_camera"]) == 2
        assert min(row["psnr"]) > LEAST
        assert 0 < row["ms_frame_tenths"][0] <= row["ms_frame"] <= row["ms_frame_tenths"][1]
        assert (row["head_gflop"] > 0) == row["head"]
        if row["timed"]:
            again = {f"seen_{name}" for name in SPLAT}
            parts = SPLAT | {"compose", "present"} | (HEAD | again if row["head"] else set())
            assert set(row["ms_kernels"]) == parts
            assert min(row["ms_kernels"][name] for name in SPLAT) > 0
            assert (row["ms_head"] > 0) == row["head"]
