"""Where a view gets its primitives from: the field of this process, or a part of it.

:func:`sundae_ns.rendering.render_view` takes a :class:`LocalField`; several GPUs train on a subclass of it, which asks
other ranks (``sundae_ns.distributed``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from sundae_ns.gaussians.field import Field
from sundae_ns.rasterization import Backend, harmonic_colors
from sundae_ns.rendering.views import View

NEAR_PLANE = 0.01
"""Distance of the near plane, world units."""


class StepResolution(NamedTuple):
    """Form of the training images at one step: a function of the step and the options."""

    step: int
    """Training step."""
    downscale: int
    """Divisor of the sides of the images."""
    window_pixels: int
    """Most pixels of an image; larger images are trained on by a random window. 0 for no limit."""
    mirror: bool = False
    """Whether half of the steps see their image in a mirror."""


class TrainingView(NamedTuple):
    """A training view for passes that do not train."""

    view: View
    """The camera."""
    mask: Tensor | None
    """Pixels that count, bool ``[H, W, 1]``; None for all."""


@dataclass(frozen=True)
class ColorSettings:
    """How stored colours become colours seen from a camera."""

    backend: Backend
    active_sh_degree: int | None = None
    """Highest SH degree in use; None for the degree of the field."""


def colors_from(params: Mapping[str, Tensor], field: Field, center: Tensor, settings: ColorSettings) -> Tensor:
    """Colours of primitives as seen from a place.

    Args:
        params: ``means`` ``[M, 3]``, ``features_dc`` and ``features_rest`` of the primitives.
        field: the field that they belong to, for its encoding.
        center: camera centre ``[3]``, or one for each primitive ``[M, 3]``; world units.
        settings: backend and SH degree.

    Returns:
        ``[M, 3]``, at least 0.
    """
    if field.encoding == "logits":
        return params["features_dc"].sigmoid()
    degree = degree_in_use(field.sh_degree, settings.active_sh_degree)
    coefficients = params["features_dc"], params["features_rest"]
    return harmonic_colors(degree, params["means"], center, *coefficients, backend=settings.backend)


def degree_in_use(sh_degree: int, active: int | None) -> int:
    """The SH degree that colours are evaluated at: ``active``, at most the field's own; None for the field's own."""
    return sh_degree if active is None else min(active, sh_degree)


class LocalField:
    """The primitives of one process.

    Args:
        field: the primitives.
        whole: False for a part, whose tensors are new each time.
    """

    def __init__(self, field: Field, *, whole: bool = True) -> None:
        self.field = field
        self.replayable = whole
        """Whether frames may be recorded: the tensors stay where they are."""

    @property
    def total(self) -> int:
        """Number of primitives of the whole field."""
        return self.field.num_primitives

    def primitives(
        self, view: View, settings: ColorSettings, *, features: bool, colors: bool = True
    ) -> dict[str, Tensor]:
        """Parameters of the primitives that the view may see ``[M, ...]``, with ``colors`` from its camera ``[M, 3]``.

        Args:
            view: the camera.
            settings: how colours are evaluated.
            features: whether feature vectors are needed.
            colors: whether colours are needed.
        """
        primitives = dict(self.field)
        if colors:
            primitives["colors"] = colors_from(self.field, self.field, view.center, settings)
        return primitives
