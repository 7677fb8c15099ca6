"""Write the embedded capture in nerfstudio's format, without overwriting files of other programs."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from sundae_ns.data.cameras import Camera, orbit
from sundae_ns.data.points import sparse_points
from sundae_ns.data.shapes import Array
from sundae_ns.data.still_life import still_life
from sundae_ns.data.tracer import render
from sundae_ns.errors import ConfigError, DataError

TRANSFORMS = "transforms.json"
POINT_CLOUD = "sparse_pc.ply"
MARKER = ".sundae_scene.json"
"""Lists the files of an embedded capture; its presence permits to replace them. Written first."""


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


def _claim(out: Path, files: Sequence[str]) -> None:
    """Create ``out`` with its marker, or clear the files of an earlier embedded capture; refuse any other folder."""
    marker = out / MARKER
    if out.exists() and not out.is_dir():
        raise DataError(f"{out} is a file; name a folder for the capture.")
    if marker.exists():
        try:
            stale = [str(name) for name in json.loads(marker.read_text())["files"]]
        except (ValueError, KeyError, TypeError) as error:
            raise DataError(
                f"{marker} is damaged; remove it and the capture in {out}, or name another folder."
            ) from error
        for name in [*stale, TRANSFORMS]:
            # An edited marker must not delete files outside its folder.
            if (out / name).resolve().is_relative_to(out.resolve()):
                (out / name).unlink(missing_ok=True)
    elif out.is_dir() and any(out.iterdir()):
        raise DataError(f"{out} holds other files than an embedded capture; name a new or an empty folder.")
    (out / "images").mkdir(parents=True, exist_ok=True)
    marker.write_text(json.dumps({"files": list(files)}, indent=1))


def write_embedded_capture(
    out: Path,
    *,
    seed: int = 0,
    train_views: int = 48,
    test_views: int = 8,
    width: int = 128,
    height: int = 128,
    points: int = 2000,
    samples: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Render the embedded still life and write it as a nerfstudio data set.

    Writes ``images/*.png``, ``sparse_pc.ply`` and, last, ``transforms.json`` with its own train/test split: a folder of
    an interrupted run has none. The same arguments give the same bytes on the same machine.

    Args:
        out: folder; new, empty, or with an earlier embedded capture, which is replaced.
        seed: varies placement, textures, light, cameras and points.
        test_views: number of held-out images, spread between the training views.
        width, height: pixels.
        samples: each pixel is the mean of ``samples`` x ``samples`` rays.
        progress: called with (views done, all views) after each view.

    Returns:
        ``out``, the value for ``--data``.

    Raises:
        ConfigError: a count or size is too small.
        DataError: ``out`` is a file, or holds other files.
    """
    for name, value, minimum in (
        ("seed", seed, 0),
        ("train_views", train_views, 3),
        ("test_views", test_views, 1),
        ("width", width, 16),
        ("height", height, 16),
        ("points", points, 1),
        ("samples", samples, 1),
    ):
        if not value >= minimum:
            raise ConfigError(f"{name} is {value}; it must be {minimum} or more.")
    if test_views > train_views:
        raise ConfigError(f"{test_views} test views do not fit between {train_views} training views; give fewer.")

    out = Path(out)
    total = train_views + test_views
    held_out = held_out_indices(train_views, test_views)
    names = [f"images/frame_{i + 1:05d}.png" for i in range(total)]
    _claim(out, [*names, POINT_CLOUD, TRANSFORMS])

    scene = still_life(seed)
    cameras = orbit(total, width=width, height=height, rng=np.random.default_rng([seed, 2]))
    images = []
    for i, (camera, name) in enumerate(zip(cameras, names, strict=True)):
        image = render(scene, camera, samples=samples)
        Image.fromarray(np.round(image * 255).astype(np.uint8)).save(out / name)
        images.append(image)
        if progress is not None:
            progress(i + 1, total)

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
