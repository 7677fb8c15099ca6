"""From a field to images: views, sources of primitives, one splatting pass, the head, contribution, recorded frames."""

from sundae_ns.rendering.contribution import contribution
from sundae_ns.rendering.render import RenderSettings, compensate, draw, render, scale_plan
from sundae_ns.rendering.replay import FrameReplay
from sundae_ns.rendering.source import (
    ColorSettings,
    FieldSource,
    LocalField,
    Primitives,
    StepResolution,
    TrainingView,
    ViewBatch,
)
from sundae_ns.rendering.views import View, view_of, zoomed

__all__ = [
    "ColorSettings",
    "FieldSource",
    "FrameReplay",
    "LocalField",
    "Primitives",
    "RenderSettings",
    "StepResolution",
    "TrainingView",
    "View",
    "ViewBatch",
    "compensate",
    "contribution",
    "draw",
    "render",
    "scale_plan",
    "view_of",
    "zoomed",
]
