"""Videos that show a scene beside its photographs, view after view."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont, ImageOps

from sundae_ns.evaluation.comparison_image import ComparisonRow
from sundae_ns.evaluation.metrics import psnr

WIDEST = 1920
"""Largest width of a frame in pixels, which every player decodes."""
_NARROWEST = 240
"""Smallest width of an image in pixels, below which its caption does not fit."""
_CAPTION = 24
_FONT_SIZE = 14
_TEXT = (255, 255, 255)
_BT709 = 1
"""Number of the colour space in a video's header; without it, players guess from the size."""


def side_by_side(row: ComparisonRow, tile: tuple[int, int], *, head: bool) -> Image.Image:
    """A frame of a view: base colours, compensated image and truth, with PSNR and the row's title below.

    It is an RGB image with even sides, at most ``WIDEST`` pixels wide.

    Args:
        row: the view.
        tile: width and height in pixels for each image; one of another shape gets black borders. Narrow tiles are
            enlarged, and wide ones reduced.
        head: whether the field has a head; without one, the compensated image is left out.
    """
    truth = torch.as_tensor(row.truth)
    base = float(psnr(torch.as_tensor(row.base), truth))
    columns = [(row.base, f"base colours, {base:.1f} dB" if head else f"rendered, {base:.1f} dB")]
    if head:
        compensated = float(psnr(torch.as_tensor(row.compensated), truth))
        columns.append((row.compensated, f"with the head, {compensated:.1f} dB"))
    columns.append((row.truth, row.title))
    enlarged = max(1, -(-_NARROWEST // tile[0]))  # whole, so that pixels stay pixels
    factor = min(enlarged, WIDEST / (len(columns) * tile[0]))
    # Videos store colours at half the size, so their sides are even.
    width, height = (2 * max(round(side * factor / 2), 1) for side in tile)
    filtering = Image.Resampling.NEAREST if factor >= 1 else Image.Resampling.LANCZOS
    frame = Image.new("RGB", (len(columns) * width, height + _CAPTION))
    draw, font = ImageDraw.Draw(frame), ImageFont.load_default(_FONT_SIZE)
    for column, (pixels, caption) in enumerate(columns):
        array = (255 * torch.as_tensor(pixels).detach().cpu().clamp(0, 1)).round().to(torch.uint8).numpy()
        frame.paste(ImageOps.pad(Image.fromarray(array), (width, height), filtering), (column * width, 0))
        centre = (column * width + width / 2, height + _CAPTION / 2)
        draw.text(centre, caption, fill=_TEXT, font=font, anchor="mm")
    return frame


def write_video(path: Path, frames: Iterable[Image.Image], *, frames_per_second: float = 6) -> int:
    """Write RGB frames of one size with even sides as an MP4 (H.264), which browsers play; returns their number.

    PyAV brings its own encoder, so no ffmpeg is needed. The path may have any suffix.
    """
    import av

    count = 0
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream(
            "libx264", rate=Fraction(frames_per_second).limit_denominator(1001), options={"crf": "18"}
        )
        stream.pix_fmt = "yuv420p"
        stream.codec_context.colorspace = _BT709
        for image in frames:
            if count == 0:
                stream.width, stream.height = image.size
            frame = av.VideoFrame.from_image(image).reformat(format="yuv420p", dst_colorspace=_BT709)
            container.mux(stream.encode(frame))
            count += 1
        container.mux(stream.encode(None))
    return count
