"""Bad images of a capture, and unusual captures that train."""

from __future__ import annotations

import itertools
import json
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from PIL import Image
from small_captures import HEIGHT, VIEWS, WIDTH, bytes_of, load, meta_of

from sundae_ns.compensation import HeadConfig
from sundae_ns.errors import DataError
from sundae_ns.model import SundaeModelConfig


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.seeds(24)
def test_corrupted_image(capture: Path, corrupted: Any, verdict: Any, suffix: str, seed: int) -> None:
    meta = meta_of(capture)
    source = capture / meta["frames"][0]["file_path"]
    target = source.with_suffix(f".{suffix}")
    with Image.open(source) as image:
        image.convert("RGB").save(target)
    target.write_bytes(corrupted(target.read_bytes(), seed))
    old, new = meta["frames"][0]["file_path"], str(target.relative_to(capture))
    (capture / "transforms.json").write_text((capture / "transforms.json").read_text().replace(old, new))
    verdict(lambda: load(capture), bytes_of(capture))


def bomb(width: int, height: int) -> bytes:
    """A PNG whose header claims more pixels than follow."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 99)) + chunk(b"IEND", b"")
    )


def _saved(kind: str, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Callable[[Path], Any]:
    return lambda path: Image.new(kind, size).save(path)


IMAGES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "16 bits": (_saved("I;16"), "pixels of type I;16"),
    "a palette": (_saved("P"), "pixels of type P"),
    "grey with alpha": (_saved("LA"), "pixels of type LA"),
    "one pixel": (_saved("RGB", (1, 1)), "1 x 1 px but its camera says"),
    "empty": (lambda path: path.write_bytes(b""), "not an image"),
    "a folder": (lambda path: (path.unlink(), path.mkdir()), "cannot be read"),
    "missing": (lambda path: path.unlink(), "cannot be read|none"),
    "a bomb": (lambda path: path.write_bytes(bomb(30000, 30000)), "claims|exceeds limit|30000"),
    "a smaller bomb": (lambda path: path.write_bytes(bomb(9000, 9000)), "claims 9000 x 9000 px"),
    "right header, no pixels": (lambda path: path.write_bytes(bomb(WIDTH, HEIGHT)), "cannot be decoded"),
}


@pytest.mark.parametrize("which", ["train", "test"])
@pytest.mark.parametrize("kind", IMAGES)
def test_images_are_refused_by_name(capture: Path, verdict: Any, kind: str, which: str) -> None:
    make, cause = IMAGES[kind]
    meta = meta_of(capture)
    name = meta["train_filenames"][-1] if which == "train" else meta["test_filenames"][0]
    make(capture / name)
    if (kind, which) == ("right header, no pixels", "test"):
        return  # detected when the test views are decoded
    error = verdict(lambda: load(capture), bytes_of(capture))
    assert error is not None
    assert Path(name).name in str(error)
    assert isinstance(error, DataError)
    assert re.search(cause, str(error)), error


def _each_image(change: Callable[[Image.Image], Image.Image]) -> Callable[[Path], None]:
    def make(data: Path) -> None:
        for path in (data / "images").iterdir():
            with Image.open(path) as image:
                changed = change(image)
            changed.save(path)

    return make


def _one_pixel(data: Path) -> None:
    _each_image(lambda image: image.resize((1, 1)))(data)
    meta = meta_of(data)
    meta.update(w=1, h=1, cx=0.5, cy=0.5)
    (data / "transforms.json").write_text(json.dumps(meta))


def _masks(data: Path) -> None:
    meta = meta_of(data)
    (data / "masks").mkdir()
    for index, frame in enumerate(meta["frames"]):
        frame["mask_path"] = f"masks/{index}.png"
        half = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
        half[:, : WIDTH // 2] = 255
        Image.fromarray(half).save(data / frame["mask_path"])
    (data / "transforms.json").write_text(json.dumps(meta))


def _renamed(data: Path) -> None:
    meta = meta_of(data)
    for frame in meta["frames"]:
        path = data / frame["file_path"]
        path.rename(path.with_name("ünï cöde 像 " + path.name))
    text = json.dumps(meta, ensure_ascii=False).replace("images/", "images/ünï cöde 像 ")
    (data / "transforms.json").write_text(text, encoding="utf-8")


def _no_points(data: Path) -> None:
    meta = meta_of(data)
    del meta["ply_file_path"]
    (data / "transforms.json").write_text(json.dumps(meta))


def _one_view(data: Path) -> None:
    meta = meta_of(data)
    meta["frames"] = meta["frames"][:1]
    for split in ("train", "val", "test"):
        meta.pop(f"{split}_filenames", None)
    meta["frames"][0]["transform_matrix"][0][3] += 1.0
    (data / "transforms.json").write_text(json.dumps(meta))


FINE: dict[str, Callable[[Path], None]] = {
    "unchanged": lambda data: None,
    "grey": _each_image(lambda image: image.convert("L")),
    "with alpha": _each_image(lambda image: image.convert("RGBA")),
    "one pixel": _one_pixel,
    "masks": _masks,
    "unicode and spaces in names": _renamed,
    "no points": _no_points,
}


def train_a_step(data: Path) -> None:
    """Train one step with the head, and evaluate the test views."""
    datamanager = load(data)
    metadata = datamanager.train_dataset.metadata
    points = metadata.get("points3D_xyz")
    config = SundaeModelConfig(
        head=HeadConfig(mode="residual", size="tiny"),
        camera_optimizer=CameraOptimizerConfig(mode="off"),
        sh_degree=1,
        num_random=50,
        num_downscales=0,
    )
    model = config.setup(
        scene_box=datamanager.train_dataset.scene_box,
        num_train_data=VIEWS,
        metadata=metadata,
        seed_points=None if points is None else (points, metadata["points3D_rgb"]),
    )
    model.train()
    model.step = config.pruning.prune_at + 1
    camera, batch = datamanager.next_train(0)
    outputs = model(camera)
    losses = model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))
    loss = torch.stack(list(losses.values())).sum()
    loss.backward()
    assert torch.isfinite(loss)
    model.eval()
    for camera, batch in datamanager.fixed_indices_eval_dataloader:
        metrics, _ = model.get_image_metrics_and_images(model.get_outputs_for_camera(camera), batch)
        assert np.isfinite(metrics["psnr"])


@pytest.fixture(scope="module")
def compiled(scene: Path) -> None:
    """Compile the CPU rasteriser before its first use under limits of time and memory."""
    train_a_step(scene)


FOLDERS = ("scene", "a folder, with spaces", "ünï cöde 像")


@pytest.mark.parametrize(
    ("kind", "folder"), [*zip(FINE, itertools.cycle(FOLDERS)), *(("unchanged", folder) for folder in FOLDERS[1:])]
)
def test_unusual_captures_train(compiled: None, capture: Path, verdict: Any, kind: str, folder: str) -> None:
    data = capture.rename(capture.with_name(folder))
    FINE[kind](data)
    assert verdict(lambda: train_a_step(data), bytes_of(data)) is None


def test_one_view_succeeds_or_fails_with_one_line(capture: Path, verdict: Any) -> None:
    _one_view(capture)
    verdict(lambda: load(capture), bytes_of(capture))
