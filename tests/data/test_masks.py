"""Masks of photos: one for each, of its size, found by its name."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from sundae_ns.data.masks import masks_of
from sundae_ns.data.photos import photo_of
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
    assert masks_of([photo_of(photo)], mask.parent) == [mask]


@pytest.mark.parametrize("orientation", [6, 8])
def test_the_mask_of_a_turned_photo_has_its_upright_size(tmp_path: Path, orientation: int) -> None:
    photo = saved(tmp_path / "photos" / "a.jpg", "RGB", orientation=orientation)
    mask = saved(tmp_path / "masks" / "a.png", "L", (12, 16))
    assert masks_of([photo_of(photo)], mask.parent) == [mask]


@pytest.mark.parametrize(("orientation", "size"), [(3, (16, 12)), (6, (12, 12))])
def test_a_mask_that_may_be_turned_is_refused(tmp_path: Path, orientation: int, size: tuple[int, int]) -> None:
    photo = saved(tmp_path / "photos" / "a.jpg", "RGB", size, orientation)
    mask = saved(tmp_path / "masks" / "a.png", "L", size)
    with pytest.raises(DataError, match="is turned by its EXIF entry"):
        masks_of([photo_of(photo)], mask.parent)


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
            masks_of([photo_of(photo)], masks)
