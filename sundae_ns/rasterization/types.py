"""Arguments and result of a rasterisation, and the protocol of a backend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from torch import Tensor


@dataclass(frozen=True)
class Inputs:
    """Arguments of :func:`sundae_ns.rasterization.rasterize`, checked."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    colors: Tensor  # [N, C]
    viewmat: Tensor  # [4, 4]
    K: Tensor  # [3, 3]
    width: int
    height: int
    near_plane: float
    far_plane: float
    antialiased: bool
    absgrad: bool
    render_depth: bool


@dataclass(frozen=True)
class Rasterization:
    """One rendered view; all tensors have the dtype and device of the primitives, except ``radii``."""

    colors: Tensor
    """Blended colours ``[H, W, C]``, without background."""

    depth: Tensor | None
    """Expected camera z ``[H, W, 1]``, world units, 0 where nothing was blended; None unless requested."""

    alpha: Tensor
    """Accumulated opacity ``[H, W, 1]`` in [0, 1]."""

    radii: Tensor
    """Screen radius ``[N]`` in whole pixels, int32, 0 where the primitive was culled; not differentiable."""

    info: dict[str, Any]
    """Statistics that the ``DefaultStrategy`` of the installed gsplat reads, in the shapes it expects.

    ``means2d`` ``[1, N, 2]`` in pixels is part of the graph: ``retain_grad()`` works, and the backward pass sets
    ``.absgrad`` if requested. ``radii`` is ``[1, N]`` under gsplat 1.4 and ``[1, N, 2]`` from 1.5. ``width``,
    ``height`` and ``n_cameras`` are ints. ``gaussian_ids`` is None, because nothing is packed.
    """


class Backend(Protocol):
    """A rasteriser. Call it through :mod:`sundae_ns.rasterization.interface`, which checks the arguments."""

    @property
    def name(self) -> str:
        """``"gsplat"``, ``"cpu"`` or ``"reference"``."""

    def rasterize(self, inputs: Inputs) -> Rasterization:
        """Render one view."""

    def spherical_harmonics(self, degree: int, directions: Tensor, coeffs: Tensor) -> Tensor:
        """Sum of harmonics ``[N, 3]`` for directions ``[N, 3]`` (not zero) and coefficients ``[N, K, 3]``."""


@runtime_checkable
class BatchBackend(Protocol):
    """A backend that renders several views at once."""

    def rasterize_views(self, inputs: Inputs, viewmats: Tensor, Ks: Tensor, colors: Tensor) -> Tensor:
        """See :func:`sundae_ns.rasterization.rasterize_views`; of the inputs, these three take the place of one's."""


@runtime_checkable
class ColorBackend(Protocol):
    """A backend that makes colours by itself."""

    def harmonic_colors(
        self, degree: int, means: Tensor, center: Tensor, features_dc: Tensor, features_rest: Tensor
    ) -> Tensor:
        """See :func:`sundae_ns.rasterization.harmonic_colors`."""
