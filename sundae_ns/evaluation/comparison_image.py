"""Images that compare a rendering with its ground truth, with and without the head, and show the remaining error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.evaluation.metrics import psnr

ImageArray = Tensor | NDArray[np.floating]

_GAP = 6
_CAPTION = 22
_FONT_SIZE = 13
_MIN_TILE = 240
_ERROR_GAIN = 5
_BACKGROUND = (255, 255, 255)
_TEXT = (40, 40, 40)


@dataclass(frozen=True)
class ComparisonRow:
    """One view of a comparison: images ``[H, W, 3]`` in [0, 1], all of one size."""

    truth: ImageArray
    base: ImageArray
    """Rendered base colours, as viewers show the exported .ply."""
    compensated: ImageArray
    """Rendered with the head."""
    title: str = ""


def _tensor(image: ImageArray) -> Tensor:
    return torch.as_tensor(image).detach().to(device="cpu", dtype=torch.float32).clamp(0, 1)


def _tiles(row: ComparisonRow) -> tuple[list[Image.Image], list[str]]:
    """The enlarged images of a view, and their captions."""
    truth, base, compensated = (_tensor(image) for image in (row.truth, row.base, row.compensated))
    if truth.dim() != 3 or truth.shape[-1] != 3 or base.shape != truth.shape or compensated.shape != truth.shape:
        shapes = ", ".join(str(list(image.shape)) for image in (truth, base, compensated))
        raise DataError(f"Images to compare have shapes {shapes}; give three of one size, [H, W, 3].")
    error = (_ERROR_GAIN * (compensated - truth).abs()).clamp(0, 1)
    # A whole factor without interpolation keeps every pixel a pixel.
    factor = max(1, -(-_MIN_TILE // truth.shape[1]))
    size = (truth.shape[1] * factor, truth.shape[0] * factor)
    arrays = [(255 * tile).round().to(torch.uint8).numpy() for tile in (truth, base, compensated, error)]
    tiles = [Image.fromarray(array).resize(size, Image.Resampling.NEAREST) for array in arrays]
    return tiles, [row.title, *(f"PSNR {float(psnr(image, truth)):.2f} dB" for image in (base, compensated)), ""]


def comparison_sheet(rows: Sequence[ComparisonRow]) -> Image.Image:
    """A captioned image with one row per view: truth, base colours, compensated, and five times the absolute error.

    The PSNR of each rendering is printed below it. Images narrower than 240 pixels are enlarged by a whole factor.
    Sizes may differ between rows.

    Raises:
        DataError: ``rows`` is empty, or the images of a row differ in shape.
    """
    if not rows:
        raise DataError("There is nothing to compare; give at least one view.")
    font = ImageFont.load_default(_FONT_SIZE)
    strips = [_tiles(row) for row in rows]
    width = max(4 * tiles[0].width for tiles, _ in strips) + 5 * _GAP
    height = _CAPTION + sum(tiles[0].height + _CAPTION for tiles, _ in strips) + _GAP
    sheet = Image.new("RGB", (width, height), _BACKGROUND)
    draw = ImageDraw.Draw(sheet)

    def caption(text: str, column: int, tile_width: int, top: int) -> None:
        centre = _GAP + column * (tile_width + _GAP) + tile_width / 2
        draw.text((centre, top + _CAPTION / 2), text, fill=_TEXT, font=font, anchor="mm")

    headings = ("ground truth", "base colours, no head", "compensated by the head", f"{_ERROR_GAIN} x absolute error")
    for column, heading in enumerate(headings):
        caption(heading, column, strips[0][0][0].width, 0)
    top = _CAPTION
    for tiles, captions in strips:
        for column, (tile, text) in enumerate(zip(tiles, captions, strict=True)):
            sheet.paste(tile, (_GAP + column * (tile.width + _GAP), top))
            caption(text, column, tile.width, top + tile.height)
        top += tiles[0].height + _CAPTION
    return sheet
