"""Figures that the paper prints, to stand beside measured ones. Printed there, not measured by us.

Yang et al., "Spectrally Pruned Gaussian Fields with Neural Compensation", 2024. Single scenes are printed in its
ablations only; its main table has means over data sets. Times are left out on purpose: they are of another machine, and
were taken without waiting for the GPU.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

NOTE = "printed in the paper, not measured by us"


@dataclass(frozen=True)
class Printed:
    """One row of a table of the paper; None is what it does not print."""

    where: str
    """A scene, or a data set."""
    label: str
    keep_ratio: float | None
    psnr: float
    ssim: float
    lpips: float | None = None
    """Learned distance; the paper does not say by which net."""
    psnr_base: float | None = None
    """Without neural compensation: another field, trained without it."""
    ssim_base: float | None = None
    megabytes: float | None = None
    primitives: int | None = None


SCENES = (
    # "Ablations of neural compensation"; storage of bicycle from "Evaluation metrics on the bicycle scene".
    Printed("bicycle", "SUNDAE 1%", 0.01, 23.23, 0.579, 0.449, 22.79, 0.542, 43.6),
    Printed("bicycle", "SUNDAE 10%", 0.1, 24.36, 0.692, 0.321, 23.93, 0.654, 141),
    Printed("bicycle", "SUNDAE 30%", 0.3, 24.40, 0.714, 0.271, 24.05, 0.710, 447),
    # "Evaluation for different pruning strategies": points in units of 10,000.
    Printed("bicycle", "SUNDAE 50%", 0.5, 24.46, 0.719, 0.251, megabytes=710, primitives=4_210_000),
    Printed("garden", "SUNDAE 1%", 0.01, 24.42, 0.651, 0.399, 24.01, 0.614),
    Printed("garden", "SUNDAE 10%", 0.1, 26.78, 0.811, 0.218, 26.18, 0.778),
    Printed("garden", "SUNDAE 30%", 0.3, 27.36, 0.843, 0.150, 26.91, 0.826),
    Printed("counter", "SUNDAE 50%", 0.5, 28.10, 0.882, 0.192, primitives=634_000),
)

RESOLUTIONS = {"bicycle": "1237x822", "garden": "1297x840", "counter": "1558x1038"}
"""Pixels of the pictures that the paper evaluates these scenes at (images_4 outdoors, images_2 indoors)."""

DATASETS = (
    # The main table. Its 3DGS rows of Mip-NeRF 360 are means over nine scenes, the others over seven.
    Printed("Mip-NeRF 360", "3DGS 7k", None, 25.60, 0.770, 0.279, megabytes=523),
    Printed("Mip-NeRF 360", "3DGS 30k", None, 27.21, 0.815, 0.214, megabytes=734),
    Printed("Mip-NeRF 360", "SUNDAE 1%", 0.01, 24.70, 0.716, 0.375, megabytes=38),
    Printed("Mip-NeRF 360", "SUNDAE 10%", 0.1, 26.80, 0.805, 0.264, megabytes=104),
    Printed("Mip-NeRF 360", "SUNDAE 30%", 0.3, 27.24, 0.826, 0.228, megabytes=279),
    Printed("Mip-NeRF 360", "SUNDAE 50%", 0.5, 27.31, 0.827, 0.213, megabytes=393),
    Printed("Tanks and Temples", "3DGS 7k", None, 21.20, 0.767, 0.280, megabytes=270),
    Printed("Tanks and Temples", "3DGS 30k", None, 23.14, 0.841, 0.183, megabytes=411),
    Printed("Tanks and Temples", "SUNDAE 1%", 0.01, 20.49, 0.703, 0.375, megabytes=33),
    Printed("Tanks and Temples", "SUNDAE 10%", 0.1, 22.50, 0.787, 0.282, megabytes=64),
    Printed("Tanks and Temples", "SUNDAE 30%", 0.3, 23.46, 0.817, 0.242, megabytes=148),
    Printed("Tanks and Temples", "SUNDAE 50%", 0.5, 23.70, 0.830, 0.219, megabytes=228),
    Printed("Deep Blending", "3DGS 7k", None, 27.78, 0.875, 0.317, megabytes=386),
    Printed("Deep Blending", "3DGS 30k", None, 29.41, 0.903, 0.243, megabytes=676),
    Printed("Deep Blending", "SUNDAE 1%", 0.01, 26.57, 0.861, 0.355, megabytes=36),
    Printed("Deep Blending", "SUNDAE 10%", 0.1, 28.65, 0.892, 0.287, megabytes=86),
    Printed("Deep Blending", "SUNDAE 30%", 0.3, 29.40, 0.899, 0.248, megabytes=203),
    Printed("Deep Blending", "SUNDAE 50%", 0.5, 28.86, 0.900, 0.242, megabytes=312),
)

MEMBERS: Mapping[str, Sequence[str]] = {
    "Mip-NeRF 360": ("bicycle", "bonsai", "counter", "garden", "kitchen", "room", "stump"),
    "Tanks and Temples": ("train", "truck"),
    "Deep Blending": ("drjohnson", "playroom"),
}
"""Scenes of the data sets that the paper evaluates on."""


def printed_of(scene: str, resolution: str) -> list[Printed]:
    """The paper's rows of a scene, if pictures of this resolution can be compared with them.

    Args:
        scene: its published name.
        resolution: of the pictures measured, ``"1237x822"``.
    """
    return [row for row in SCENES if row.where == scene and RESOLUTIONS[scene] == resolution]
