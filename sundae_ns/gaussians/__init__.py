"""Gaussian fields: parameters and their activations, initialisation, surgery, merging and growth."""

from sundae_ns.gaussians.initialization import from_points, initial_features, random_points
from sundae_ns.gaussians.mending import mend
from sundae_ns.gaussians.parameters import FEATURES, rgb_to_sh

__all__ = ["FEATURES", "from_points", "initial_features", "mend", "random_points", "rgb_to_sh"]
