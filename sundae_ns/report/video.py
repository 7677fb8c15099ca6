"""Videos."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

from PIL import Image


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
        stream.codec_context.colorspace = 1  # BT.709; without it, players guess from the size
        for image in frames:
            if count == 0:
                stream.width, stream.height = image.size
            frame = av.VideoFrame.from_image(image).reformat(format="yuv420p", dst_colorspace=1)
            container.mux(stream.encode(frame))
            count += 1
        container.mux(stream.encode(None))
    return count
