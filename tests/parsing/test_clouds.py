"""Clouds of captures: in the scale and the colours of the file, also that of COLMAP for an old capture."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from colmap_models import write_model
from plyfile import PlyData, PlyElement

from sundae_ns.datamanager import DATASET_FRAME

Load = Callable[..., Any]
Edit = Callable[..., None]


def cloud_of(made: Any) -> tuple[torch.Tensor, torch.Tensor]:
    metadata = made.train_dataparser_outputs.metadata
    return metadata["points3D_xyz"], metadata["points3D_rgb"]


@pytest.mark.parametrize("scale", [0.1, 25.0])
def test_applied_scale_leaves_the_cloud_beside_its_cameras(capture: Path, load: Load, edit: Edit, scale: float) -> None:
    plain = load(capture)
    edit(capture, applied_scale=scale)
    made = load(capture)
    torch.testing.assert_close(cloud_of(made)[0], cloud_of(plain)[0], atol=1e-6, rtol=0)
    # Original coordinates times applied_scale are those of the file.
    transform, factor = made.train_dataset.metadata[DATASET_FRAME]
    vertex = PlyData.read(str(capture / "sparse_pc.ply"))["vertex"].data
    original = torch.tensor([[float(vertex[axis][i]) for axis in "xyz"] for i in range(5)]) / scale
    moved = factor * (original @ transform[:, :3].T + transform[:, 3])
    torch.testing.assert_close(moved, cloud_of(plain)[0][:5], atol=1e-5, rtol=0)


def test_colours_of_a_cloud_reach_the_model(capture: Path, load: Load) -> None:
    _, expected = cloud_of(load(capture))
    vertex = PlyData.read(str(capture / "sparse_pc.ply"))["vertex"].data
    kinds = [
        ("x", "f4"),
        ("y", "f4"),
        ("z", "f4"),
        ("diffuse_red", "f4"),
        ("diffuse_green", "f4"),
        ("diffuse_blue", "f4"),
    ]
    names = ("x", "y", "z", "red", "green", "blue")
    rows = np.array([tuple(float(row[name]) for name in names) for row in vertex], dtype=kinds)
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(capture / "sparse_pc.ply"))
    assert torch.equal(cloud_of(load(capture))[1], expected)


def test_a_cloud_that_the_views_do_not_show_is_named(capture: Path, load: Load, capsys: Any) -> None:
    load(capture)
    assert "show no point" not in capsys.readouterr().out
    path = capture / "sparse_pc.ply"
    cloud = PlyData.read(str(path), mmap=False)
    cloud["vertex"]["x"] += 50
    cloud.write(str(path))
    load(capture)
    said = " ".join(capsys.readouterr().out.split())
    assert "views show no point of the sparse cloud, so cloud and cameras are probably in different coordinates" in said


def test_an_old_capture_takes_the_cloud_of_its_colmap_model(capture: Path, load: Load, edit: Edit) -> None:
    """Made before ns-process-data wrote clouds; nerfstudio asks, and writes into the capture."""
    (capture / "sparse_pc.ply").unlink()
    edit(capture, ply_file_path=None)
    write_model(capture / "colmap" / "sparse" / "0", [f"{index}.png" for index in range(4)], (24, 24))
    before = (capture / "transforms.json").read_bytes()
    made = load(capture)
    points, colours = cloud_of(made)
    assert colours.tolist() == [[10, 20, 30]] * 4
    # The axes that these versions turned: x and y swapped, z negated.
    saved = torch.tensor([[0.2, 0.1 * index, -0.3] for index in range(4)])
    meta = json.loads(before)
    pose = torch.tensor(meta["frames"][0]["transform_matrix"])
    outputs = made.train_dataparser_outputs
    turned = torch.tensor([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    rotation = outputs.dataparser_transform[:, :3] @ turned
    expected = outputs.dataparser_scale * (saved @ rotation.T + outputs.dataparser_transform[:, 3])
    torch.testing.assert_close(points, expected, atol=1e-6, rtol=0)
    centre = outputs.dataparser_scale * (rotation @ pose[:3, 3] + outputs.dataparser_transform[:, 3])
    distances = (outputs.cameras.camera_to_worlds[:, :, 3] - centre).norm(dim=1)
    assert float(distances.min()) < 1e-5
    assert (capture / "transforms.json").read_bytes() == before
    assert not (capture / "sparse_pc.ply").exists()


def test_an_old_capture_without_points_starts_without_them(capture: Path, load: Load, edit: Edit) -> None:
    (capture / "colmap" / "sparse" / "0").mkdir(parents=True)
    edit(capture, ply_file_path=None)
    assert "points3D_xyz" not in load(capture).train_dataparser_outputs.metadata
