"""Masks of photos: one for each, of its size, found by its name."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from sundae_ns.data.masks import masks_of
from sundae_ns.errors import DataError


def saved(path: Path, mode: str, size: tuple[int, int] = (16, 12), orientation: int = 1) -> Path:
    path.parent.mkdir(exist_ok=True)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.new(mode, size).save(path, exif=exif)
    return path


@pytest.mark.parametrize("name", ["a.jpg", "a.jpg.png", "a.png"])
def test_the_mask_of_a_photo(tmp_path: Path, name: str) -> None:
    photo, mask = saved(tmp_path / "photos" / "a.jpg", "RGB"), saved(tmp_path / "masks" / name, "L")
    assert masks_of([photo], mask.parent) == [mask]


def test_what_does_not_fit_is_named(tmp_path: Path) -> None:
    photo, masks = saved(tmp_path / "a.jpg", "RGB"), tmp_path / "masks"
    cases = [
        (masks.mkdir, r"a\.jpg has no mask a\.png in"),
        (lambda: saved(masks / "a.png", "L", (8, 6)), "has 8 x 6 px and its photo 16 x 12; scale it"),
        (lambda: saved(masks / "a.png", "RGB"), "save it with one channel of 8 bits"),
        (lambda: (saved(masks / "a.png", "L"), saved(photo, "RGB", orientation=6)), "is turned by its EXIF entry"),
    ]
    for make, cause in cases:
        make()
        with pytest.raises(DataError, match=cause):
            masks_of([photo], masks)
