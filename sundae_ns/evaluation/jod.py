"""ColorVideoVDP (Mantiuk et al. 2024): how visible the difference of two images is, in just-objectionable differences.

10 JOD are equal images. For a difference of 1 JOD, three of four viewers prefer the reference. The authors' package is
optional; its classic metric needs no download.
"""

from __future__ import annotations

import importlib.util
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from sundae_ns.evaluation.metrics import check_pair

JOD_DISPLAY = "standard_4k"
"""Display and distance for which visibility is computed: the default of the package, 30 inches seen from 0.75 m."""
JOD_VARIANT = f"ColorVideoVDP's JOD ({JOD_DISPLAY})"
INSTALL_JOD = "pip install cvvdp"


def jod_available() -> bool:
    """Whether the package that computes JOD is installed."""
    return importlib.util.find_spec("pycvvdp") is not None


@torch.no_grad()
def jod(pred: Tensor, target: Tensor) -> Tensor | None:
    """Quality of an sRGB image ``[H, W, 3]`` beside its truth, in JOD: 10 for equal images; higher is better.

    Images are clamped to [0, 1].

    Returns:
        A float32 scalar on the inputs' device; None if the package is not installed.

    Raises:
        DataError: the shapes differ, or are not ``[H, W, 3]``.
    """
    check_pair(pred, target)
    if not jod_available():
        return None
    test, reference = (image.float().clamp(0, 1) for image in (pred, target))
    quality, _ = jod_metric(pred.device).predict(test, reference, dim_order="HWC")
    return torch.as_tensor(quality, dtype=torch.float32, device=pred.device).reshape(())


@lru_cache(maxsize=2)
def jod_metric(device: torch.device) -> Any:
    """The package's metric on a device; it also compares films ``[F, H, W, 3]``. Ask :func:`jod_available` first."""
    import pycvvdp

    return pycvvdp.cvvdp(display_name=JOD_DISPLAY, device=device, quiet=True)
