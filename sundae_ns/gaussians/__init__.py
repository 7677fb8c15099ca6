"""Gaussian fields: parameters and their activations, initialisation, surgery, merging and growth."""

from sundae_ns.gaussians.gaussians import FEATURES, mend, rgb_to_sh
from sundae_ns.gaussians.initialization import from_points, initial_features, random_points

__all__ = ["FEATURES", "from_points", "initial_features", "mend", "random_points", "rgb_to_sh"]
