"""Pictures that compare: truth, base colours, compensated, and what is still wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.evaluation.metrics import psnr

Picture = Tensor | NDArray[np.floating]

_GAP = 6
_CAPTION = 22
_FONT_SIZE = 13
_MIN_TILE = 240
_PAPER = (255, 255, 255)
_INK = (40, 40, 40)


@dataclass(frozen=True)
class ComparisonRow:
    """One view of a comparison: pictures ``[H, W, 3]`` in [0, 1], of one size."""

    truth: Picture
    base: Picture
    """Base colours: what a viewer shows of the .ply."""
    compensated: Picture
    title: str = ""


def _tensor(picture: Picture) -> Tensor:
    return torch.as_tensor(picture).detach().to(device="cpu", dtype=torch.float32).clamp(0, 1)


def _tiles(row: ComparisonRow, error_gain: float) -> list[NDArray[np.uint8]]:
    truth, base, compensated = (_tensor(picture) for picture in (row.truth, row.base, row.compensated))
    if truth.dim() != 3 or truth.shape[-1] != 3 or base.shape != truth.shape or compensated.shape != truth.shape:
        shapes = ", ".join(str(list(picture.shape)) for picture in (truth, base, compensated))
        raise DataError(f"Pictures to compare have shapes {shapes}; give three of one size, [H, W, 3].")
    error = (error_gain * (compensated - truth).abs()).clamp(0, 1)
    return [(255 * tile).round().to(torch.uint8).numpy() for tile in (truth, base, compensated, error)]


def side_by_side(truth: Picture, base: Picture, compensated: Picture, error_gain: float = 5.0) -> NDArray[np.uint8]:
    """Truth, base colours, compensated, and the compensated picture's absolute error times a gain, left to right.

    Args:
        truth: ``[H, W, 3]`` in [0, 1], tensor or array.
        base: the same shape.
        compensated: the same shape.
        error_gain: factor on the error, which is clipped at 1.

    Returns:
        uint8 ``[H, 4 W, 3]``.

    Raises:
        DataError: the shapes differ, or are not those of pictures.
    """
    return np.concatenate(_tiles(ComparisonRow(truth, base, compensated), error_gain), axis=1)


def comparison_sheet(rows: Sequence[ComparisonRow], *, error_gain: float = 5.0) -> Image.Image:
    """A captioned sheet with one row a view; the PSNR stands below each rendering. Small pictures are enlarged.

    Args:
        rows: the views, of any sizes.
        error_gain: factor on the error.

    Raises:
        DataError: there are no rows, or pictures of a row differ in shape.
    """
    if not rows:
        raise DataError("There is nothing to compare; give at least one view.")
    font = ImageFont.load_default(_FONT_SIZE)
    strips = []
    for row in rows:
        tiles = [Image.fromarray(tile) for tile in _tiles(row, error_gain)]
        # Whole factors and no interpolation: a pixel stays a pixel.
        factor = max(1, -(-_MIN_TILE // tiles[0].width))
        tiles = [tile.resize((tile.width * factor, tile.height * factor), Image.Resampling.NEAREST) for tile in tiles]
        truth = _tensor(row.truth)
        quality = [f"{float(psnr(_tensor(picture), truth)):.2f} dB" for picture in (row.base, row.compensated)]
        strips.append((tiles, [row.title, *quality, ""]))

    width = max(4 * tiles[0].width for tiles, _ in strips) + 5 * _GAP
    height = _CAPTION + sum(tiles[0].height + _CAPTION for tiles, _ in strips) + _GAP
    sheet = Image.new("RGB", (width, height), _PAPER)
    draw = ImageDraw.Draw(sheet)

    def caption(text: str, column: int, tile_width: int, top: int) -> None:
        centre = _GAP + column * (tile_width + _GAP) + tile_width / 2
        draw.text((centre, top + _CAPTION / 2), text, fill=_INK, font=font, anchor="mm")

    heads = ("ground truth", "base colours", "compensated", f"error x {error_gain:g}")
    for column, head in enumerate(heads):
        caption(head, column, strips[0][0][0].width, 0)
    top = _CAPTION
    for tiles, captions in strips:
        for column, (tile, text) in enumerate(zip(tiles, captions, strict=True)):
            sheet.paste(tile, (_GAP + column * (tile.width + _GAP), top))
            caption(text, column, tile.width, top + tile.height)
        top += tiles[0].height + _CAPTION
    return sheet


def save_comparison(path: Path, rows: Sequence[ComparisonRow], *, error_gain: float = 5.0) -> None:
    """Write :func:`comparison_sheet` to a file; its suffix says the format, and its folder must exist."""
    comparison_sheet(rows, error_gain=error_gain).save(path)
