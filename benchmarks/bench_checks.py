"""Time the checks of a large capture against nerfstudio's own reading of it; print one JSON line.

python benchmarks/bench_checks.py > benchmarks/results/reliability/checks.json
"""

from __future__ import annotations

import argparse
import json
import struct
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from nerfstudio.data.utils import colmap_parsing_utils
from nerfstudio.utils.io import load_from_json

from sundae_ns.data import check_colmap, check_transforms


def seconds(fn: Callable[[], object]) -> float:
    began = time.perf_counter()
    fn()
    return time.perf_counter() - began


def write_model(model: Path, images: int, observations: int, points: int, track: int) -> None:
    model.mkdir(parents=True)
    (model / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, 1600, 1200, 1500.0, 1500.0, 800.0, 600.0))
    seen = np.zeros(observations, dtype=[("x", "<f8"), ("y", "<f8"), ("point", "<i8")]).tobytes()
    content = [struct.pack("<Q", images)]
    for index in range(images):
        content.append(struct.pack("<i7di", index, 1, 0, 0, 0, index, 0, 0, 1) + f"{index:06d}.jpg".encode() + b"\0")
        content.append(struct.pack("<Q", observations) + seen)
    (model / "images.bin").write_bytes(b"".join(content))
    point = struct.pack("<Q3d3BdQ", 1, 0.1, 0.2, 0.3, 1, 2, 3, 0.5, track) + struct.pack("<ii", 1, 1) * track
    (model / "points3D.bin").write_bytes(struct.pack("<Q", points) + point * points)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=1000)
    parser.add_argument("--observations", type=int, default=2000, help="of each image")
    parser.add_argument("--points", type=int, default=200_000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        model, transforms = Path(name) / "sparse", Path(name) / "transforms.json"
        write_model(model, options.images, options.observations, options.points, track=6)
        frame = {"transform_matrix": np.eye(4).tolist()}
        frames = [{**frame, "file_path": f"images/{index:06d}.jpg"} for index in range(options.images)]
        shared = {"fl_x": 1500, "fl_y": 1500, "cx": 800, "cy": 600, "w": 1600, "h": 1200}
        transforms.write_text(json.dumps({**shared, "frames": frames}))

        def parse() -> None:
            colmap_parsing_utils.read_cameras_binary(model / "cameras.bin")
            colmap_parsing_utils.read_images_binary(model / "images.bin")
            colmap_parsing_utils.read_points3D_binary(model / "points3D.bin")

        check, read = seconds(lambda: check_colmap(model, None)), seconds(parse)
        check_json, read_json = (
            seconds(lambda: check_transforms(transforms)),
            seconds(lambda: load_from_json(transforms)),
        )
    result = {
        **vars(options),
        "colmap_check_s": round(check, 3),
        "colmap_check_share_of_reading": round(check / read, 3),
        "transforms_check_s": round(check_json, 3),
        "transforms_json_alone_s": round(read_json, 3),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
