"""The reference backend: pure torch, any device, float32 or float64, independent of gsplat."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, ClassVar

import torch
from torch import Tensor

from sundae_ns.rasterization.compositing import composite
from sundae_ns.rasterization.harmonics import evaluate_harmonics
from sundae_ns.rasterization.projection import Projection, project
from sundae_ns.rasterization.tiles import build_tile_lists
from sundae_ns.rasterization.types import Inputs, Rasterization

_SMALLEST_ALPHA = 1e-10  # lower bound of the divisor of depths; the alpha of any blended pixel is larger


class ReferenceBackend:
    """Autograd projection and tiled blending, with the thresholds of gsplat 1.4's CUDA kernels."""

    name = "reference"
    _project: ClassVar[Callable[..., Projection]] = staticmethod(project)
    _build_lists: ClassVar[Callable[..., Any]] = staticmethod(build_tile_lists)
    _composite: ClassVar[Callable[..., tuple[Tensor, Tensor]]] = staticmethod(composite)

    def rasterize(self, inputs: Inputs) -> Rasterization:
        """Render one view."""
        projection = self._project(inputs)
        opacities, colors = inputs.opacities, inputs.colors
        if inputs.antialiased:
            opacities = opacities * projection.compensations
        if inputs.render_depth:
            colors = torch.cat([colors, projection.depths[:, None]], dim=-1)
        means2d = projection.means2d[None]
        lists = self._build_lists(projection, opacities, inputs.width, inputs.height)
        image, alpha = self._composite(means2d, projection.conics, opacities, colors, lists, inputs.absgrad)
        return finished(image, alpha, means2d, _per_axis(projection.radii)[None], inputs)

    def spherical_harmonics(self, degree: int, directions: Tensor, coeffs: Tensor) -> Tensor:
        """Sum of harmonics ``[N, 3]`` for directions ``[N, 3]`` (not zero) and coefficients ``[N, K, 3]``."""
        return evaluate_harmonics(degree, directions, coeffs)


def finished(image: Tensor, alpha: Tensor, means2d: Tensor, radii: Tensor, inputs: Inputs) -> Rasterization:
    """The result of a backend.

    Args:
        image: Blended channels ``[H, W, C]``; the last is camera z if depth was requested.
        alpha: Accumulated opacity ``[H, W, 1]``.
        means2d: Centres ``[1, N, 2]``.
        radii: ``[1, N]``, or one per axis ``[1, N, 2]``.
        inputs: What was rendered.
    """
    depth = None
    if inputs.render_depth:
        image, depth = image[..., :-1], image[..., -1:] / alpha.clamp(min=_SMALLEST_ALPHA)
    info = strategy_info(means2d, radii, inputs.width, inputs.height)
    return Rasterization(colors=image, depth=depth, alpha=alpha, radii=largest_axis(radii[0]), info=info)


def _per_axis(radii: Tensor) -> Tensor:
    """Radii ``[N]`` in the shape that the installed gsplat's strategies expect: ``[N]`` in 1.4, ``[N, 2]`` from 1.5."""
    return radii[:, None].expand(-1, 2) if _radii_per_axis() else radii


def largest_axis(radii: Tensor) -> Tensor:
    """Radii of either gsplat, ``[N]`` or ``[N, 2]``, as one per primitive ``[N]``."""
    return radii if radii.dim() == 1 else radii.amax(dim=-1)


def strategy_info(means2d: Tensor, radii: Tensor, width: int, height: int) -> dict[str, Any]:
    """The ``info`` of a :class:`Rasterization`, from centres ``[1, N, 2]`` and radii ``[1, N]`` or ``[1, N, 2]``."""
    return {
        "means2d": means2d,
        "radii": radii,
        "width": width,
        "height": height,
        "n_cameras": 1,
        "gaussian_ids": None,
    }


@lru_cache(maxsize=1)
def _radii_per_axis() -> bool:
    """Whether strategies of the installed gsplat expect radii ``[1, N, 2]``, as from 1.5, and not ``[1, N]``."""
    try:
        major, minor = version("gsplat").split(".")[:2]
    except PackageNotFoundError:
        return False
    return (int(major), int(minor)) >= (1, 5)
