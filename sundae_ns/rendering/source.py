"""Where a view gets its primitives from: the field of this process, or shards on several GPUs.

:func:`sundae_ns.rendering.render_view` takes a :class:`FieldSource`. Only the place that makes the source knows how
many processes hold the field.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

from torch import Tensor
from torch.optim import Optimizer

from sundae_ns.gaussians.field import Field
from sundae_ns.rasterization import Backend, harmonic_colors
from sundae_ns.rendering.views import View

if TYPE_CHECKING:
    from sundae_ns.rasterization.sharded import Route

NEAR_PLANE = 0.01
"""Distance of the near plane, world units."""


class StepResolution(NamedTuple):
    """Form of the training images at one step: a function of the step and the options, so the same on all ranks."""

    step: int
    """Training step; with several ranks, of a batch of one image a rank."""
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


class ViewBatch(NamedTuple):
    """The views that the processes render at the same time, one each."""

    own: TrainingView
    """The view of this process."""
    num_views: int
    """Number of views in the batch that count; the last batch may repeat a view to keep every rank busy."""


class Primitives(dict[str, Tensor]):
    """Parameters of the primitives that a view needs ``[M, ...]``, and ``colors`` from its camera ``[M, 3]``."""

    route: Route | None = None
    """How they came from other ranks; None for primitives of this process."""


@dataclass(frozen=True)
class ColorSettings:
    """How stored colours become colours seen from a camera."""

    backend: Backend
    active_sh_degree: int | None = None
    """Highest SH degree in use; None for the degree of the field."""


class FieldSource(Protocol):
    """What rendering and training need of a field, whoever holds its primitives.

    Methods with a body are those of a field of one process.
    """

    field: Field
    """The primitives of this process."""
    collective: bool
    """Whether a render is collective: all ranks must call it together."""
    replayable: bool
    """Whether frames of this source may be recorded: its tensors stay where they are."""

    @property
    def total(self) -> int:
        """Number of primitives of the whole field."""
        return self.field.num_primitives

    def primitives(
        self,
        view: View,
        settings: ColorSettings,
        *,
        features: bool,
        colors: bool = True,
        at: StepResolution | None = None,
    ) -> Primitives:
        """The primitives that the view may see.

        Args:
            view: the camera.
            settings: how colours are evaluated.
            features: whether feature vectors are needed.
            colors: whether colours are needed.
            at: the step, for a training image; None outside of training.
        """

    def plan_next(self, at: StepResolution, optimizers: Mapping[str, Optimizer]) -> None:
        """Prepare the next training step while the GPU works on this one."""

    def batches(self, views: Sequence[TrainingView]) -> Sequence[ViewBatch]:
        """The views in batches of one for each process, in order."""
        return [ViewBatch(view, 1) for view in views]

    def accumulate(self, total: Tensor, values: Tensor, primitives: Primitives, batch: ViewBatch) -> None:
        """Add values of the primitives of a batch ``[M]`` to a sum over the primitives of this process ``[N]``."""
        total += values


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


class LocalField(FieldSource):
    """The field of one process.

    Args:
        field: the primitives.
        whole: False for a part, whose tensors are new each time.
    """

    collective = False

    def __init__(self, field: Field, *, whole: bool = True) -> None:
        self.field = field
        self.replayable = whole

    def primitives(
        self,
        view: View,
        settings: ColorSettings,
        *,
        features: bool,
        colors: bool = True,
        at: StepResolution | None = None,
    ) -> Primitives:
        """All primitives, with their colours; see :meth:`FieldSource.primitives`."""
        primitives = Primitives(self.field)
        if colors:
            primitives["colors"] = colors_from(self.field, self.field, view.center, settings)
        return primitives

    def plan_next(self, at: StepResolution, optimizers: Mapping[str, Optimizer]) -> None:
        """Nothing to prepare."""
