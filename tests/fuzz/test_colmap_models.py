"""Bad COLMAP models, loaded by the datamanager of training."""

from __future__ import annotations

import os
import re
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from colmap_models import write_model
from small_captures import SIZE, bytes_of, load, write_text_model

from sundae_ns.data.colmap import check_colmap
from sundae_ns.errors import DataError


def test_valid_models_are_read(capture: Path, verdict: Any) -> None:
    assert verdict(lambda: load(capture, colmap=True), bytes_of(capture)) is None
    binary = load(capture, colmap=True)
    names = sorted(path.name for path in (capture / "images").iterdir())
    shutil.rmtree(capture / "sparse")
    write_text_model(capture / "sparse" / "0", names)
    text = load(capture, colmap=True)
    assert torch.equal(binary.train_dataset.cameras.camera_to_worlds, text.train_dataset.cameras.camera_to_worlds)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.seeds(40)
def test_corrupted_model(capture: Path, corrupted: Any, verdict: Any, file: str, seed: int) -> None:
    path = capture / "sparse" / "0" / file
    path.write_bytes(corrupted(path.read_bytes(), seed))
    verdict(lambda: load(capture, colmap=True), bytes_of(capture))


@pytest.mark.parametrize("file", ["cameras.txt", "images.txt", "points3D.txt"])
@pytest.mark.seeds(20)
def test_corrupted_text_model(capture: Path, corrupted: Any, verdict: Any, file: str, seed: int) -> None:
    names = sorted(path.name for path in (capture / "images").iterdir())
    shutil.rmtree(capture / "sparse")
    write_text_model(capture / "sparse" / "0", names)
    path = capture / "sparse" / "0" / file
    path.write_bytes(corrupted(path.read_bytes(), seed))
    verdict(lambda: load(capture, colmap=True), bytes_of(capture))


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize("file", ["cameras", "images", "points3D"])
def test_a_model_cut_short_anywhere_is_refused(tmp_path: Path, file: str, text: bool) -> None:
    names = [f"{index}.png" for index in range(3)]
    write_text_model(tmp_path, names) if text else write_model(tmp_path, names, SIZE)
    path = tmp_path / f"{file}.{'txt' if text else 'bin'}"
    content = path.read_bytes()
    if text:  # as COLMAP does
        rows = 1 if file == "cameras" else len(names)
        content = f"# List of {file}\n# Number of {file[:6]}: {rows}, mean length: 2\n".encode() + content
    # The last entry of a text may lose letters or observations.
    end = content.rindex(b"2.png" if file == "images" else b"\n", 0, -1) if text else len(content)
    check_colmap(tmp_path, None)
    for length in range(end):
        if text and length < content.find(b"mean"):
            continue  # the count itself is cut
        path.write_bytes(content[:length])
        with pytest.raises(DataError):
            check_colmap(tmp_path, None)


def test_a_pipe_in_a_capture_is_refused_at_once(capture: Path, verdict: Any) -> None:
    for path, colmap in ((capture / "transforms.json", False), (capture / "sparse" / "0" / "images.bin", True)):
        path.unlink()
        os.mkfifo(path)
        assert "pipe" in str(verdict(lambda colmap=colmap: load(capture, colmap=colmap), bytes_of(capture)))


def _patch(file: str, at: int, content: bytes) -> Callable[[Path], None]:
    def change(model: Path) -> None:
        data = bytearray((model / file).read_bytes())
        data[at : at + len(content)] = content
        (model / file).write_bytes(data)

    return change


def _twice(model: Path) -> None:
    camera = (model / "cameras.bin").read_bytes()[8:]
    (model / "cameras.bin").write_bytes(struct.pack("<Q", 2) + camera * 2)


def _folder(file: str) -> Callable[[Path], None]:
    def change(model: Path) -> None:
        (model / file).unlink(missing_ok=True)
        (model / file).mkdir()

    return change


def _spaced(model: Path) -> None:
    write_text_model(model, ["an image.png"])


_NAME = 8 + 64 + len("frame_00001.png") + 1  # offset of the first image's number of observations
MODELS: dict[str, tuple[Callable[[Path], None], str]] = {
    "2^63 cameras": (_patch("cameras.bin", 0, struct.pack("<Q", 1 << 63)), "cameras.bin states"),
    "2^40 images": (_patch("images.bin", 0, struct.pack("<Q", 1 << 40)), "images.bin states"),
    "2^30 observations": (
        _patch("images.bin", _NAME, struct.pack("<Q", 1 << 30)),
        "observations, more than it can hold",
    ),
    "2^60 points": (_patch("points3D.bin", 0, struct.pack("<Q", 1 << 60)), "points3D.bin states"),
    "a track of 2^31": (_patch("points3D.bin", 8 + 43, struct.pack("<Q", 1 << 31)), "points3D.bin states"),
    "zero focal length": (_patch("cameras.bin", 8 + 24, struct.pack("<d", 0.0)), "camera 1: parameter fx is 0.0"),
    "NaN focal length": (_patch("cameras.bin", 8 + 24, struct.pack("<d", float("nan"))), "parameter fx is nan"),
    "zero width": (_patch("cameras.bin", 8 + 8, struct.pack("<Q", 0)), "width is 0"),
    "an unknown camera model": (_patch("cameras.bin", 8 + 4, struct.pack("<i", 7)), "not support camera model FOV"),
    "a zero quaternion": (_patch("images.bin", 8 + 4, struct.pack("<4d", 0, 0, 0, 0)), "image 1: its quaternion"),
    "a NaN position": (_patch("images.bin", 8 + 36, struct.pack("<d", float("nan"))), "image 1: the pose is nan"),
    "a missing camera": (_patch("images.bin", 8 + 60, struct.pack("<i", 9)), "camera 9 is not in the model"),
    "a name for a shell": (_patch("images.bin", 8 + 64, b"$(reboot).png!!"), "rename it without quotes"),
    "an endless name": (_patch("images.bin", 8 + 64, b"a" * 10**4), "without an end"),
    "no images": (lambda model: (model / "images.bin").write_bytes(struct.pack("<Q", 0)), "has no images"),
    "no points": (lambda model: (model / "points3D.bin").write_bytes(struct.pack("<Q", 0)), "has no points"),
    "no file of images": (lambda model: (model / "images.bin").unlink(), "images.bin cannot be read"),
    "no files": (shutil.rmtree, "is not a folder"),
    "no file of cameras": (lambda model: (model / "cameras.bin").unlink(), "holds neither cameras.bin nor cameras.txt"),
    "a camera twice": (_twice, "camera 1: it is listed twice"),
    "a folder in the place of a file": (_folder("cameras.bin"), "cannot be read"),
    "a folder in the place of a text": (_folder("cameras.txt"), "cannot be read"),
    "invalid UTF-8": (lambda model: (model / "cameras.txt").write_bytes(b"1 PIN\xff\xfe"), "is not UTF-8 text"),
    "a text with a space in a name": (_spaced, "does not read names with spaces"),
    "a missing image": (lambda model: next((model.parents[1] / "images").iterdir()).unlink(), "does not exist"),
}


@pytest.mark.parametrize("kind", MODELS)
def test_models_are_refused_by_name(capture: Path, verdict: Any, kind: str) -> None:
    change, cause = MODELS[kind]
    change(capture / "sparse" / "0")
    error = verdict(lambda: load(capture, colmap=True), bytes_of(capture))
    assert error is not None
    assert isinstance(error, DataError)
    assert re.search(cause, str(error)), error


def test_a_model_without_points_starts_without_them(capture: Path, verdict: Any) -> None:
    (capture / "sparse" / "0" / "points3D.bin").unlink()
    assert verdict(lambda: load(capture, colmap=True), bytes_of(capture)) is None
    assert "points3D_xyz" not in load(capture, colmap=True).train_dataset.metadata
