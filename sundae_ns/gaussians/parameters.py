"""Names, shapes and activations of the parameters of a Gaussian field.

A field is a mapping from the names below to tensors that share their first dimension, the number of primitives N. Values
are stored before activation, as 3DGS and splatfacto do:

=================  ==============  ===============================================================
name               shape           meaning
=================  ==============  ===============================================================
``means``          ``[N, 3]``      centres, world units
``scales``         ``[N, 3]``      log of the standard deviations, world units
``quats``          ``[N, 4]``      rotation as wxyz quaternion, not normalised
``features_dc``    ``[N, 3]``      spherical harmonics, band 0
``features_rest``  ``[N, K, 3]``   spherical harmonics, bands 1 and up
``opacities``      ``[N, 1]``      logit of the opacity
``features``       ``[N, F]``      splatted feature vectors (c_i of the paper's neural image); optional
=================  ==============  ===============================================================
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

SH_C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi))."""

SPLAT_NAMES = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")
"""What every 3DGS field has; the names are those of splatfacto's checkpoints."""

FEATURES = "features"
"""The extra parameter that SUNDAE attaches to each primitive."""


def num_primitives(params: Mapping[str, Tensor]) -> int:
    """Number of primitives N in a field."""
    return params["means"].shape[0]


def sh_degree(features_rest: Tensor) -> int:
    """Degree of spherical harmonics whose bands 1 and up are ``[N, K, 3]``, K = (degree + 1)^2 - 1."""
    return round((features_rest.shape[1] + 1) ** 0.5) - 1


def rgb_to_sh(rgb: Tensor) -> Tensor:
    """Band-0 coefficient ``[..., 3]`` whose colour is ``rgb`` ``[..., 3]`` in [0, 1]."""
    return (rgb - 0.5) / SH_C0


def sh_to_rgb(sh: Tensor) -> Tensor:
    """View-independent colour ``[..., 3]`` of a band-0 coefficient ``[..., 3]``; not clamped."""
    return sh * SH_C0 + 0.5


def rgb_to_logit(rgb: Tensor) -> Tensor:
    """Logit ``[..., 3]`` of a colour ``[..., 3]``, which is kept a thousandth away from 0 and 1."""
    return torch.logit(rgb.clamp(1e-3, 1 - 1e-3))


def finite_mask(params: Mapping[str, Tensor]) -> Tensor:
    """True where every parameter of a primitive is finite: bool ``[N]``."""
    n = num_primitives(params)
    mask = torch.ones(n, dtype=torch.bool, device=params["means"].device)
    for value in params.values():
        mask &= torch.isfinite(value.detach().flatten(1)).all(dim=1)
    return mask
