"""Small captures of the fuzz tests, loaded by the datamanager of training."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from sundae_ns.plugin.datamanager import SundaeDatamanager, SundaeDatamanagerConfig

VIEWS, WIDTH, HEIGHT = 4, 20, 16
SIZE = WIDTH, HEIGHT


def write_text_model(folder: Path, names: list[str]) -> None:
    """Write the model of :func:`write_model` as text."""
    folder.mkdir(parents=True, exist_ok=True)
    cameras = f"# cameras\n1 PINHOLE {WIDTH} {HEIGHT} 18 18 {WIDTH / 2} {HEIGHT / 2}\n"
    images, points = "# images\n", "# points\n"
    for index, name in enumerate(names):
        images += f"{index + 1} 1 0 0 0 {0.3 * index} 0.1 3.0 1 {name}\n3.0 4.0 {index}\n"
        points += f"{index} {0.1 * index} 0.2 0.3 10 20 30 0.5 1 0 2 0\n"
    for file, text in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{file}.txt").write_text(text, encoding="utf-8")


def manager(data: Path, *, colmap: bool = False, downscale_factor: int | None = None) -> SundaeDatamanager:
    parser: Any = NerfstudioDataParserConfig(load_3D_points=True, downscale_factor=downscale_factor)
    if colmap:
        parser = ColmapDataParserConfig(colmap_path=Path("sparse/0"), eval_mode="all")
    config = SundaeDatamanagerConfig(data=data, dataparser=parser, cache_images_type="uint8")
    return config.setup(device="cpu", test_mode="val")


def load(data: Path, *, colmap: bool = False) -> SundaeDatamanager:
    """Load a capture and every training view, as training does."""
    datamanager = manager(data, colmap=colmap)
    for step in range(len(datamanager.train_indices)):
        datamanager.next_train(step)
    assert torch.isfinite(datamanager.train_dataset.cameras.camera_to_worlds).all()
    return datamanager


def bytes_of(data: Path) -> int:
    return sum(path.stat().st_size for path in data.rglob("*") if path.is_file())


def meta_of(data: Path) -> dict[str, Any]:
    return json.loads((data / "transforms.json").read_text())


def names_of(data: Path) -> list[str]:
    return sorted(path.name for path in (data / "images").iterdir())
