"""Small captures of the demo's still life, for tests and benchmarks: fewer and smaller images, and fewer points."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image
from plyfile import PlyData, PlyElement

from sundae_ns.data.capture_files import write_demo_capture


def write_still_life(
    out: Path,
    *,
    train_views: int = 48,
    test_views: int = 8,
    width: int = 128,
    height: int = 128,
    points: int = 2000,
) -> Path:
    """Write views of the demo's capture, spread evenly around it, as a capture of its own."""
    total, side = train_views + test_views, max(width, height)
    (out / "images").mkdir(parents=True)
    with tempfile.TemporaryDirectory() as folder:
        demo = write_demo_capture(Path(folder) / "demo")
        meta = json.loads((demo / "transforms.json").read_text(encoding="utf-8"))
        frames = [meta["frames"][int(i * len(meta["frames"]) / total)] for i in range(total)]
        for number, frame in enumerate(frames, start=1):
            left, top = (side - width) // 2, (side - height) // 2
            with Image.open(demo / frame["file_path"]) as image:
                kind = Image.Resampling.BOX if side <= image.width else Image.Resampling.BICUBIC
                scaled = image.resize((side, side), kind).crop((left, top, left + width, top + height))
            frame["file_path"] = f"images/frame_{number:05d}.png"
            scaled.save(out / frame["file_path"])
        cloud = PlyData.read(str(demo / "sparse_pc.ply"), mmap=False)["vertex"].data
    chosen = np.random.default_rng(0).permutation(len(cloud))[:points]
    PlyData([PlyElement.describe(cloud[chosen], "vertex")], byte_order="<").write(str(out / "sparse_pc.ply"))
    names = [frame["file_path"] for frame in frames]
    test = [names[int((i + 0.5) * total / test_views)] for i in range(test_views)]
    focal = meta["fl_x"] * side / meta["w"]
    camera = {"fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2, "w": width, "h": height}
    splits = {"train_filenames": [name for name in names if name not in test], "val_filenames": test}
    meta.update(camera, **splits, test_filenames=test, frames=frames)
    (out / "transforms.json").write_text(json.dumps(meta, indent=1), encoding="utf-8")
    return out
