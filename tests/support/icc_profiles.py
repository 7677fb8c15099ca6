"""ICC profiles, and the judge of what they make of an image."""

from __future__ import annotations

import io
import struct
from typing import Any

import numpy as np
from PIL import Image, ImageCms

# Colorants of the profiles, adapted to D50 as ICC asks, and the exponent of their curves.
SPACES = {
    "P3": ((0.5151, 0.2412, -0.0011), (0.2920, 0.6922, 0.0419), (0.1571, 0.0666, 0.7841), 2.2),
    "DCI": ((0.4862, 0.2267, -0.0008), (0.3239, 0.7103, 0.0432), (0.1542, 0.0630, 0.7825), 2.2),
    "Adobe RGB": ((0.6097, 0.3111, 0.0195), (0.2053, 0.6257, 0.0609), (0.1492, 0.0632, 0.7446), 563 / 256),
    "ProPhoto": ((0.7977, 0.2880, 0.0), (0.1352, 0.7119, 0.0), (0.0313, 0.0001, 0.8249), 1.8),
}


def profile(space: str) -> bytes:
    """An ICC profile (version 2) of three colorants and a curve, or of a grey curve."""

    def xyz(*values: float) -> bytes:
        return b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(value * 65536) for value in values))

    def curve(gamma: float) -> bytes:
        return b"curv\0\0\0\0" + struct.pack(">IH2x", 1, round(gamma * 256))

    tags = {"wtpt": xyz(0.9642, 1.0, 0.8249)}
    if space == "grey":
        tags["kTRC"] = curve(1.0)
    else:
        *colorants, gamma = SPACES[space]
        for name, colorant in zip("rgb", colorants):
            tags |= {f"{name}XYZ": xyz(*colorant), f"{name}TRC": curve(gamma)}  # type: ignore[arg-type,misc]
    table, body, start = struct.pack(">I", len(tags)), b"", 128 + 4 + 12 * len(tags)
    for name, tag in tags.items():
        table += struct.pack(">4sII", name.encode(), start + len(body), len(tag))
        body += tag
    kind = b"GRAY" if space == "grey" else b"RGB "
    header = struct.pack(">I4xI4s4s4s12x4s", start + len(body), 0x02400000, b"mntr", kind, b"XYZ ", b"acsp")
    return header.ljust(68, b"\0") + struct.pack(">3i", 63190, 65536, 54061) + bytes(48) + table + body


def judged(image: Image.Image, space: str) -> np.ndarray:
    """The pixels in sRGB by ImageCms."""
    stated = ImageCms.ImageCmsProfile(io.BytesIO(profile(space)))
    converted: Any = ImageCms.profileToProfile(image, stated, ImageCms.createProfile("sRGB"), outputMode="RGB")
    return np.asarray(converted, int)
