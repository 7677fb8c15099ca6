"""Gaussian fields: parameters and their activations, initialisation, surgery, merging and relocation."""

from sundae_ns.gaussians.initialization import from_points, initial_features, random_points
from sundae_ns.gaussians.parameters import FEATURES, finite_mask, rgb_to_sh

__all__ = ["FEATURES", "finite_mask", "from_points", "initial_features", "random_points", "rgb_to_sh"]
