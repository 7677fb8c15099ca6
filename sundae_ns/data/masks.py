"""Masks of photos, put into the capture that is made of them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from sundae_ns.data.capture import check_image, read_json
from sundae_ns.data.orientation import TURNED, exif_orientation
from sundae_ns.data.photos import Photo
from sundae_ns.errors import DataError, one_line


def masks_of(photos: Sequence[Photo], folder: Path) -> list[Path]:
    """The mask of each photo: an image in ``folder`` with the photo's name, or with ``.png`` behind it or in its place.

    Raises:
        DataError: a photo has no mask, or one of another size, or one that may be turned otherwise.
    """
    found = []
    for photo in photos:
        path, wanted = photo.path, photo.size
        names = (path.name, f"{path.name}.png", f"{path.stem}.png", f"{path.stem}.jpg")
        mask = next((folder / name for name in names if (folder / name).is_file()), None)
        if mask is None:
            raise DataError(f"{path} has no mask {path.stem}.png in {folder}; add it, white where pixels count")
        size = check_image(mask, mask=True)
        # A mask of the upright size is upright; where both sizes are the same, nothing says so.
        if exif_orientation(path) != 1 and (
            size != wanted or size == size[::-1] or exif_orientation(path) not in TURNED
        ):
            raise DataError(f"{path} is turned by its EXIF entry, and its mask is not; save both upright")
        if wanted not in (size, (0, 0)):
            raise DataError(f"{mask} has {size[0]} x {size[1]} px and its photo {wanted[0]} x {wanted[1]}; scale it")
        found.append(mask)
    return found


def add_masks(capture: Path, masks: Sequence[Path]) -> str:
    """Copy masks into a capture, at the sizes of its images, and name them in its frames.

    Args:
        capture: whose images are named ``frame_00001`` and so on, in the order of the masks.
        masks: one for each photo.

    Returns:
        How many frames have theirs, ``24 of 24``.
    """
    meta: dict[str, Any] = dict(read_json(capture / "transforms.json"))
    by_name = {f"frame_{number:05d}": mask for number, mask in enumerate(masks, start=1)}
    for frame in meta["frames"]:
        name = Path(frame["file_path"]).stem
        if name in by_name:
            frame["mask_path"] = f"masks/{name}.png"
    for images in sorted(capture.glob("images*")):
        folder = capture / images.name.replace("images", "masks", 1)
        folder.mkdir(exist_ok=True)
        _write_masks(images, folder, by_name)
    partial = capture / "transforms.json.partial"  # a killed command must not cost the poses
    partial.write_text(json.dumps(meta, indent=4), encoding="utf-8")
    partial.replace(capture / "transforms.json")
    return f"{sum('mask_path' in frame for frame in meta['frames'])} of {len(meta['frames'])}"


def _write_masks(images: Path, folder: Path, masks: Mapping[str, Path]) -> None:
    for image in images.iterdir():
        if image.stem in masks:
            try:
                with Image.open(masks[image.stem]) as mask:
                    scaled = mask.convert("L").resize(check_image(image), Image.Resampling.NEAREST)
            except (OSError, ValueError, SyntaxError) as error:
                raise DataError(f"{masks[image.stem]} cannot be decoded ({one_line(error)}); save it again") from error
            scaled.save(folder / f"{image.stem}.png")
