"""From a field to images: views, sources of primitives, one splatting pass, the head, contribution, recorded frames."""

from sundae_ns.rendering.render import (
    ColorSettings,
    LocalField,
    RenderSettings,
    StepResolution,
    TrainingView,
    compensate,
    contribution,
    draw,
    render_view,
    scale_plan,
)
from sundae_ns.rendering.views import View, view_of, zoomed

__all__ = [
    "ColorSettings",
    "LocalField",
    "RenderSettings",
    "StepResolution",
    "TrainingView",
    "View",
    "compensate",
    "contribution",
    "draw",
    "render_view",
    "scale_plan",
    "view_of",
    "zoomed",
]
