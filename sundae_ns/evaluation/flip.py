"""FLIP, a perceptual error without learned weights; it needs the optional package of its authors."""

from __future__ import annotations

import importlib.util

import numpy as np
import torch
from torch import Tensor

from sundae_ns.evaluation.metrics import check_pair

VARIANT = "LDR-FLIP, 67 pixels per degree"
"""Variant of the metric: low dynamic range, at the default viewing distance of the authors' tools."""

INSTALL = "pip install flip-evaluator"
"""Command that installs the package."""


def flip_available() -> bool:
    """Whether the package is installed."""
    return importlib.util.find_spec("flip_evaluator") is not None


@torch.no_grad()
def flip(pred: Tensor, target: Tensor) -> Tensor | None:
    """Mean FLIP error of two sRGB images, in [0, 1]; lower is better.

    Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", 2020, computed by its authors' package,
    ``flip-evaluator``, on the CPU.

    Args:
        pred: ``[H, W, 3]``; clamped to [0, 1].
        target: ``[H, W, 3]``; clamped to [0, 1].

    Returns:
        A float32 scalar on the inputs' device; None if the package is not installed.

    Raises:
        DataError: the shapes differ, or are not ``[H, W, 3]``.
    """
    check_pair(pred, target)
    if not flip_available():
        return None
    from flip_evaluator import evaluate

    reference, test = (np.ascontiguousarray(image.float().clamp(0, 1).cpu().numpy()) for image in (target, pred))
    _, mean, _ = evaluate(reference, test, "LDR", applyMagma=False)
    return torch.tensor(mean, dtype=torch.float32, device=pred.device)
