"""Gaussian fields: parameters and their activations, initialisation, surgery, merging and relocation. Floor 2."""

from sundae_ns.gaussians.initialization import from_points, initial_features, random_points
from sundae_ns.gaussians.parameters import (
    FEATURES,
    SPLAT_NAMES,
    finite_mask,
    num_primitives,
    rgb_to_sh,
    sh_to_rgb,
)
from sundae_ns.gaussians.surgery import keep

__all__ = [
    "FEATURES",
    "SPLAT_NAMES",
    "finite_mask",
    "from_points",
    "initial_features",
    "keep",
    "num_primitives",
    "random_points",
    "rgb_to_sh",
    "sh_to_rgb",
]
