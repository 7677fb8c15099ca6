"""Names, shapes and activations of the parameters of a Gaussian field.

A field is a mapping from the names below to tensors that share their first dimension, the number of primitives N.
Values are stored before activation, as 3DGS and splatfacto do:

=================  ==============  ===============================================================
name               shape           meaning
=================  ==============  ===============================================================
``means``          ``[N, 3]``      centres, world units
``scales``         ``[N, 3]``      log of the standard deviations, world units
``quats``          ``[N, 4]``      rotation as wxyz quaternion, not normalised
``features_dc``    ``[N, 3]``      spherical harmonics, degree 0
``features_rest``  ``[N, K, 3]``   spherical harmonics, degrees 1 and up
``opacities``      ``[N, 1]``      logit of the opacity
``features``       ``[N, F]``      splatted feature vectors (c_i in the paper's neural image); optional
=================  ==============  ===============================================================
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

SH_C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi))."""

SPLAT_NAMES = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")
"""Parameters of every 3DGS field, named as in splatfacto's checkpoints."""

_COLUMNS = {"means": 3, "scales": 3, "quats": 4, "features_dc": 3, "opacities": 1}

MAX_SH_DEGREE = 4
"""Highest SH degree of a field."""

FEATURES = "features"
"""Name of the parameter that SUNDAE adds to each primitive."""


def num_primitives(params: Mapping[str, Tensor]) -> int:
    """Number of primitives N in a field."""
    return params["means"].shape[0]


def sh_degree(features_rest: Tensor) -> int:
    """SH degree of coefficients ``[N, K, 3]`` of degrees 1 and up, K = (degree + 1)^2 - 1."""
    return round((features_rest.shape[1] + 1) ** 0.5) - 1


def sh_degree_of(coefficients: int) -> int | None:
    """SH degree with (degree + 1)^2 - 1 = ``coefficients`` per channel of degrees 1 and up; None if no degree has."""
    return next((d for d in range(MAX_SH_DEGREE + 1) if (d + 1) ** 2 - 1 == coefficients), None)


def odd_shapes(params: Mapping[str, Tensor]) -> list[str]:
    """Descriptions of the parameters with a wrong shape, for an error message; N is the length of ``means``.

    Args:
        params: has all of :data:`SPLAT_NAMES`; ``features`` are not checked.
    """
    n = params["means"].shape[0] if params["means"].ndim else 0
    rest = params["features_rest"].shape
    known = len(rest) > 1 and sh_degree_of(rest[1]) is not None
    wanted: dict[str, tuple[int | str, ...]] = {name: (n, columns) for name, columns in _COLUMNS.items()}
    wanted["features_rest"] = (n, rest[1] if known else "(degree + 1)^2 - 1", 3)
    return [
        f"{name} has shape {list(params[name].shape)}; it must be [{', '.join(map(str, shape))}]"
        for name, shape in wanted.items()
        if tuple(params[name].shape) != shape
    ]


def rgb_to_sh(rgb: Tensor) -> Tensor:
    """SH coefficient of degree 0 ``[..., 3]`` whose colour is ``rgb`` ``[..., 3]`` in [0, 1]."""
    return (rgb - 0.5) / SH_C0


def sh_to_rgb(sh: Tensor) -> Tensor:
    """View-independent colour ``[..., 3]`` of an SH coefficient of degree 0 ``[..., 3]``; not clamped."""
    return sh * SH_C0 + 0.5


def rgb_to_logit(rgb: Tensor) -> Tensor:
    """Logit ``[..., 3]`` of a colour ``[..., 3]``, clamped to [0.001, 0.999]."""
    return torch.logit(rgb.clamp(1e-3, 1 - 1e-3))


def finite_mask(params: Mapping[str, Tensor]) -> Tensor:
    """True where every parameter of a primitive is finite: bool ``[N]``."""
    n = num_primitives(params)
    mask = torch.ones(n, dtype=torch.bool, device=params["means"].device)
    for value in params.values():
        mask &= torch.isfinite(value.detach().flatten(1)).all(dim=1)
    return mask
