"""Captures as the field's usual programs write them, in small: each parses to the cameras that it states."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from colmap_models import write_model
from nerfstudio.cameras.cameras import CameraType

Load = Callable[..., Any]
LENS = {"fl_x": 33.0, "fl_y": 33.5, "cx": 12.25, "cy": 11.75, "w": 24, "h": 24}


def names_of(data: Path) -> list[str]:
    return sorted(path.name for path in (data / "images").iterdir())


def rewritten(data: Path, top: dict[str, Any], own: Callable[[int], dict[str, Any]]) -> None:
    frames = json.loads((data / "transforms.json").read_text())["frames"]
    kept = [{"file_path": f["file_path"], "transform_matrix": f["transform_matrix"]} for f in frames]
    meta = {**top, "frames": [{**frame, **own(index)} for index, frame in enumerate(kept)]}
    (data / "transforms.json").write_text(json.dumps(meta))


AXES = [[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]
NO_DISTORTION = {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
WRITERS: dict[str, tuple[dict[str, Any], Callable[[int], dict[str, Any]]]] = {
    "ns-process-data": (
        {**LENS, "k1": 0.01, "k2": -0.01, "p1": 1e-4, "p2": 2e-4, "camera_model": "OPENCV", "applied_transform": AXES},
        lambda index: {"colmap_im_id": index + 1},
    ),
    "ns-process-data, several cameras": (
        {"applied_transform": AXES},
        lambda index: {**LENS, **NO_DISTORTION, "fl_x": 33.0 + index, "camera_model": "OPENCV", "colmap_im_id": index},
    ),
    "ns-process-data, a fisheye video": (
        {**LENS, "k1": 0.03, "k2": 0.01, "k3": 0.0, "k4": 0.002, "camera_model": "OPENCV_FISHEYE"},
        lambda index: {},
    ),
    "Polycam": (
        {"camera_model": "OPENCV", "orientation_override": "none"},
        lambda index: {**LENS, "fl_x": 33.0 + 0.1 * index},
    ),
    "Record3D": ({**LENS, "camera_model": "OPENCV", "k1": 0, "k2": 0, "p1": 0, "p2": 0}, lambda index: {}),
    "Metashape": (
        {"camera_model": "OPENCV", "applied_transform": AXES},
        lambda index: {**LENS, "fl_y": 33.0, "k1": 0.02, "k2": -0.01, "k3": 0.001, "k4": 0.0, "p1": 1e-4, "p2": 1e-4},
    ),
    "Metashape, k4": (
        {"camera_model": "OPENCV"},
        lambda index: {**LENS, "k1": 0.02, "k2": -0.01, "k3": 0.001, "k4": 0.004, "p1": 1e-4, "p2": 1e-4},
    ),
    "RealityScan": (
        {"camera_model": "OPENCV"},
        lambda index: {**LENS, "k1": -0.05, "k2": 0.02, "k3": 0.0, "k4": 0.0, "p1": 0.0, "p2": 0.0},
    ),
    "instant-ngp": (
        {
            **LENS,
            "camera_angle_x": 0.7,
            "camera_angle_y": 0.7,
            "k1": 0.01,
            "k2": 0.0,
            "p1": 0.0,
            "p2": 0.0,
            "is_fisheye": False,
            "aabb_scale": 16,
        },
        lambda index: {"sharpness": 30.0 + index},
    ),
}


@pytest.mark.parametrize("writer", WRITERS)
def test_files_of_other_programs(capture: Path, load: Load, writer: str) -> None:
    top, own = WRITERS[writer]
    rewritten(capture, top, own)
    made = load(capture)
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    stated = {Path(frame["file_path"]).name: {**top, **frame} for frame in frames}
    lens = made.train_dataparser_outputs.cameras
    for at, path in enumerate(made.train_dataset.image_filenames):
        entry = stated[path.name]
        for name, values in (("fl_x", lens.fx), ("fl_y", lens.fy), ("cx", lens.cx), ("cy", lens.cy)):
            assert float(values[at]) == pytest.approx(entry[name], rel=1e-6)
        distortion = [entry.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2")]
        assert lens.distortion_params[at].tolist() == pytest.approx(distortion, abs=1e-7)
        fisheye = entry.get("camera_model") == "OPENCV_FISHEYE"
        assert int(lens.camera_type[at]) == (CameraType.FISHEYE if fisheye else CameraType.PERSPECTIVE).value
    for batch in made.cached_train:
        assert batch["image"].float().std() > 1
    # The capture turns and scales as a whole: distances between cameras keep their ratios.
    found = torch.cdist(lens.camera_to_worlds[:, :, 3], lens.camera_to_worlds[:, :, 3])
    centres = torch.tensor([stated[p.name]["transform_matrix"] for p in made.train_dataset.image_filenames])[:, :3, 3]
    ratio = torch.cdist(centres, centres) * made.train_dataparser_outputs.dataparser_scale
    torch.testing.assert_close(found, ratio, atol=1e-5, rtol=1e-4)


def _rigs(model: Path) -> None:
    """Files that COLMAP writes beside its model from 3.12 on."""
    (model / "rigs.bin").write_bytes(struct.pack("<Q", 0))
    (model / "frames.bin").write_bytes(struct.pack("<Q", 0))


def _project(model: Path) -> None:
    (model / "project.ini").write_text("log_to_stderr=false\n")


LAYOUTS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "COLMAP 3.6": ("sparse/0", _project),
    "COLMAP 3.12": ("sparse/0", _rigs),
    "the undistorter": ("sparse", lambda _: None),
    "ns-process-data": ("colmap/sparse/0", _project),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_models_of_colmap(capture: Path, load: Load, layout: str) -> None:
    place, add = LAYOUTS[layout]
    write_model(capture / place, names_of(capture), (24, 24), lenses=[(2, [33.0, 12.0, 12.0, 0.02])])
    add(capture / place)
    (capture / "transforms.json").unlink()
    made = load(capture, colmap=place)
    lens = made.train_dataparser_outputs.cameras
    assert float(lens.fx[0]) == 33.0
    assert float(lens.distortion_params[0, 0]) == pytest.approx(0.02)
    assert len(made.train_dataset) + len(made.eval_dataset) == len(names_of(capture))
    assert len(made.train_dataparser_outputs.metadata["points3D_xyz"]) == len(names_of(capture))
