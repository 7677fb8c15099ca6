"""Write the still life in nerfstudio's format."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ray_tracing.cameras import Camera, orbit
from ray_tracing.points import sparse_points
from ray_tracing.shapes import Array
from ray_tracing.still_life import still_life
from ray_tracing.tracer import render

TRANSFORMS = "transforms.json"
POINT_CLOUD = "sparse_pc.ply"


def held_out_indices(train_views: int, test_views: int) -> list[int]:
    """Indices of the test views: evenly spread, so that each lies between training views."""
    total = train_views + test_views
    return [int((j + 0.5) * total / test_views) for j in range(test_views)]


def _write_point_cloud(path: Path, xyz: Array, rgb: Array) -> None:
    names = ["x", "y", "z", "red", "green", "blue"]
    vertices = np.empty(len(xyz), dtype=list(zip(names, ["<f4"] * 3 + ["u1"] * 3, strict=True)))
    for name, column in zip(names, [*xyz.T, *rgb.T], strict=True):
        vertices[name] = column
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}"]
    header += [f"property {'float' if name in 'xyz' else 'uchar'} {name}" for name in names]
    path.write_bytes("\n".join([*header, "end_header\n"]).encode("ascii") + vertices.tobytes())


def _transforms(cameras: Sequence[Camera], names: Sequence[str], held_out: Sequence[int]) -> dict[str, object]:
    first = cameras[0]
    test = [names[i] for i in held_out]
    return {
        "camera_model": "OPENCV",
        "fl_x": first.focal,
        "fl_y": first.focal,
        "cx": first.width / 2,
        "cy": first.height / 2,
        "w": first.width,
        "h": first.height,
        "k1": 0.0,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
        "ply_file_path": POINT_CLOUD,
        "train_filenames": [name for name in names if name not in set(test)],
        "val_filenames": test,
        "test_filenames": test,
        "frames": [
            {"file_path": name, "transform_matrix": camera.camera_to_world.tolist()}
            for name, camera in zip(names, cameras, strict=True)
        ],
    }


def still_life_views(seed: int, count: int, *, width: int, height: int) -> list[Camera]:
    """``count`` cameras around the still life of a seed; width and height in pixels."""
    return orbit(count, width=width, height=height, rng=np.random.default_rng([seed, 2]))


def write_still_life(
    out: Path,
    *,
    seed: int = 0,
    train_views: int = 48,
    test_views: int = 8,
    width: int = 128,
    height: int = 128,
    points: int = 2000,
    samples: int = 2,
) -> Path:
    """Render the still life and write it as a nerfstudio data set.

    Writes ``images/*.png``, ``sparse_pc.ply`` and, last, ``transforms.json`` with its own train/test split. The same
    arguments give the same bytes on the same machine.

    Args:
        out: folder without images; created if missing.
        seed: varies placement, textures, light, cameras and points.
        train_views: number of training images.
        test_views: number of held-out images, spread between the training views; at most ``train_views``.
        width, height: pixels.
        points: number of points in the sparse cloud.
        samples: each pixel is the mean of ``samples`` x ``samples`` rays.

    Returns:
        ``out``, the value for ``--data``.

    Raises:
        FileExistsError: ``out`` has images already.
    """
    total = train_views + test_views
    held_out = held_out_indices(train_views, test_views)
    names = [f"images/frame_{i + 1:05d}.png" for i in range(total)]
    (out / "images").mkdir(parents=True)
    scene = still_life(seed)
    cameras = still_life_views(seed, total, width=width, height=height)
    images = [render(scene, camera, samples=samples) for camera in cameras]
    for image, name in zip(images, names, strict=True):
        Image.fromarray(np.round(image * 255).astype(np.uint8)).save(out / name)

    training = [i for i in range(total) if i not in set(held_out)]
    xyz, rgb = sparse_points(
        scene,
        [cameras[i] for i in training],
        [images[i] for i in training],
        points,
        rng=np.random.default_rng([seed, 3]),
    )
    _write_point_cloud(out / POINT_CLOUD, xyz, rgb)
    (out / TRANSFORMS).write_text(json.dumps(_transforms(cameras, names, held_out), indent=1))
    return out
