"""Results printed in the paper, for comparison with measured ones.

Yang et al., "Spectrally Pruned Gaussian Fields with Neural Compensation", 2024. The ablations print single scenes; the main
table prints means over data sets. Times are omitted: they come from another machine and were taken without synchronisation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

NOTE = "printed in the paper, not measured by us"


@dataclass(frozen=True)
class Printed:
    """One row of a table of the paper; None if the paper does not print a value."""

    where: str
    """Scene or data set."""
    keep_ratio: float
    psnr: float
    ssim: float
    lpips: float | None = None
    """LPIPS; the paper does not name the net."""
    psnr_base: float | None = None
    """PSNR without neural compensation, of a separate field trained without it."""
    megabytes: float | None = None
    primitives: int | None = None


SCENES = (
    # "Ablations of neural compensation"; storage of bicycle from "Evaluation metrics on the bicycle scene".
    Printed("bicycle", 0.01, 23.23, 0.579, 0.449, 22.79, 43.6),
    Printed("bicycle", 0.1, 24.36, 0.692, 0.321, 23.93, 141),
    Printed("bicycle", 0.3, 24.40, 0.714, 0.271, 24.05, 447),
    # "Evaluation for different pruning strategies": points in units of 10,000.
    Printed("bicycle", 0.5, 24.46, 0.719, 0.251, megabytes=710, primitives=4_210_000),
    Printed("garden", 0.01, 24.42, 0.651, 0.399, 24.01),
    Printed("garden", 0.1, 26.78, 0.811, 0.218, 26.18),
    Printed("garden", 0.3, 27.36, 0.843, 0.150, 26.91),
    Printed("counter", 0.5, 28.10, 0.882, 0.192, primitives=634_000),
)

RESOLUTIONS = {"bicycle": "1237x822", "garden": "1297x840", "counter": "1558x1038"}
"""Width x height of the images on which the paper evaluates these scenes (images_4 outdoors, images_2 indoors)."""

DATASETS = (
    # The main table; means over the scenes of MEMBERS.
    Printed("Mip-NeRF 360", 0.01, 24.70, 0.716, 0.375, megabytes=38),
    Printed("Mip-NeRF 360", 0.1, 26.80, 0.805, 0.264, megabytes=104),
    Printed("Mip-NeRF 360", 0.3, 27.24, 0.826, 0.228, megabytes=279),
    Printed("Mip-NeRF 360", 0.5, 27.31, 0.827, 0.213, megabytes=393),
    Printed("Tanks and Temples", 0.01, 20.49, 0.703, 0.375, megabytes=33),
    Printed("Tanks and Temples", 0.1, 22.50, 0.787, 0.282, megabytes=64),
    Printed("Tanks and Temples", 0.3, 23.46, 0.817, 0.242, megabytes=148),
    Printed("Tanks and Temples", 0.5, 23.70, 0.830, 0.219, megabytes=228),
    Printed("Deep Blending", 0.01, 26.57, 0.861, 0.355, megabytes=36),
    Printed("Deep Blending", 0.1, 28.65, 0.892, 0.287, megabytes=86),
    Printed("Deep Blending", 0.3, 29.40, 0.899, 0.248, megabytes=203),
    Printed("Deep Blending", 0.5, 28.86, 0.900, 0.242, megabytes=312),
)

MEMBERS: Mapping[str, Sequence[str]] = {
    "Mip-NeRF 360": ("bicycle", "bonsai", "counter", "garden", "kitchen", "room", "stump"),
    "Tanks and Temples": ("train", "truck"),
    "Deep Blending": ("drjohnson", "playroom"),
}
"""Scenes of each data set of the paper."""


def printed_of(scene: str, resolution: str) -> list[Printed]:
    """The paper's rows of a scene; empty unless the measured images have the paper's resolution.

    Args:
        scene: the published name of the scene.
        resolution: width x height of the measured images in pixels, such as ``"1237x822"``.
    """
    return [row for row in SCENES if row.where == scene and RESOLUTIONS[scene] == resolution]
