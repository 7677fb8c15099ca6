"""From a field to the images of a view: colours, one splatting pass, and the head's correction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from sundae_ns.compensation import CompensationHead, ScalePlan, plan, resize
from sundae_ns.gaussians import FEATURES
from sundae_ns.rasterization import Rasterization, rasterize
from sundae_ns.rasterization.types import check_memory
from sundae_ns.rendering.source import NEAR_PLANE, ColorSettings, LocalField
from sundae_ns.rendering.views import View

SHOWN_BACKGROUNDS = {"random": (0.1490, 0.1647, 0.2157), "black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
"""Backgrounds of images that are not trained on, by the option ``background_color``; for random the viewer's."""


@dataclass(frozen=True)
class RenderSettings(ColorSettings):
    """What images depend on beside field and view."""

    antialiased: bool = False
    """Whether opacities compensate for the smallest footprint (``rasterize_mode`` of splatfacto)."""
    training: bool = False
    """Whether gradients are needed. The image is then not clamped, and the head runs at the scale of the image."""
    absgrad: bool = False
    """Whether to sum absolute gradients of the projected centres."""
    head: CompensationHead | None = None
    """The head; None while it is disabled."""
    trained_focal: tuple[float, float] | None = None
    """Shortest and longest focal length of the images that the head was trained on, pixels."""

    def without_head(self) -> RenderSettings:
        """The same settings with the head disabled."""
        return replace(self, head=None)


def pass_options(params: Mapping[str, Tensor], view: View, settings: RenderSettings) -> dict[str, Any]:
    """Arguments that every pass over a view hands to the rasteriser: activated parameters, camera and settings."""
    return {
        "means": params["means"],
        "quats": params["quats"],
        "scales": params["scales"].exp(),
        "opacities": params["opacities"].sigmoid().squeeze(-1),
        "viewmat": view.viewmat,
        "K": view.K,
        "width": view.width,
        "height": view.height,
        "near_plane": NEAR_PLANE,
        "antialiased": settings.antialiased,
        "backend": settings.backend,
    }


def splat(
    params: Mapping[str, Tensor], view: View, channels: Tensor, settings: RenderSettings, **options: Any
) -> Rasterization:
    """Splat values of the primitives ``[N, C]``; options are those of ``rasterize``."""
    return rasterize(colors=channels, **pass_options(params, view, settings), **options)


def scale_plan(view: View, trained_focal: tuple[float, float] | None) -> ScalePlan:
    """Scale and strength of the correction for a view, given the focal lengths that the head was trained at."""
    return plan(view.focal, trained_focal, view.width * view.height)


def draw(
    primitives: Mapping[str, Tensor], view: View, background: Tensor, settings: RenderSettings, *, depth: bool
) -> tuple[dict[str, Any], Rasterization]:
    """Splat colours, features and depth in one pass.

    Args:
        primitives: from a :class:`LocalField`; with ``features`` if the head is enabled.
        view: the camera.
        background: colour ``[3]``.
        settings: everything else.
        depth: whether to render depth.

    Returns:
        ``rgb, base_rgb, depth, accumulation, feature_image``, each ``[H, W, C]``, and the rasteriser's result. Without
        a head ``rgb`` is ``base_rgb``.
    """
    channels = primitives["colors"]
    if settings.head is not None:
        channels = torch.cat([channels, primitives[FEATURES]], dim=1)
    splatted = splat(primitives, view, channels, settings, render_depth=depth, absgrad=settings.absgrad)
    blended, features = splatted.colors[..., :3], splatted.colors[..., 3:]
    base = (blended + (1 - splatted.alpha) * background).clamp(0.0, 1.0)
    images = {
        "rgb": base,
        "base_rgb": base,
        "depth": splatted.depth,
        "accumulation": splatted.alpha,
        "feature_image": features,
    }
    return images, splatted


def compensate(head: CompensationHead, base: Tensor, splatted: Rasterization, background: Tensor) -> Tensor:
    """The compensated image of one splatting pass ``[H, W, 3]``, not clamped. This is the one place that runs the head.

    Args:
        head: the head.
        base: image without the head, ``[H, W, 3]``.
        splatted: colours and features without background.
        background: colour ``[3]``.

    Raises:
        MemoryExhaustedError: on a CPU, the layers of the head need more memory than there is.
    """
    height, width = base.shape[:2]
    if base.device.type == "cpu":
        # The last level: its input from below and beside, both joined, and its output, in float32.
        channels = 4 * head.net.out.in_channels // head.config.pixel_unshuffle**2
        check_memory(4 * channels * width * height, f"layers of the head for {width:,} x {height:,} pixels")
    image = head(base, splatted.colors, splatted.alpha)
    if head.config.mode == "features":
        # This head sees neither background nor accumulation; without blending it would paint empty space.
        image = splatted.alpha * image + (1 - splatted.alpha) * background
    return image


def render_view(
    source: LocalField,
    view: View,
    background: Tensor,
    settings: RenderSettings,
    *,
    depth: bool = True,
) -> tuple[dict[str, Any], Rasterization]:
    """The images of one view: primitives, one splatting pass, and the head.

    An image of another scale than the head was trained at is rendered at the trained scale too, and gets the resized
    correction (:mod:`sundae_ns.compensation.head`).

    Args:
        source: of the primitives.
        view: the camera.
        background: colour ``[3]``.
        settings: everything else; ``head=None`` leaves the head out.
        depth: whether to render depth.

    Returns:
        ``rgb, base_rgb, depth, accumulation, feature_image``, each ``[H, W, C]``, and the rasteriser's result.
    """
    head = settings.head
    primitives = source.primitives(view, settings, features=head is not None)
    images, splatted = draw(primitives, view, background, settings, depth=depth)
    if head is None:
        return images, splatted
    zoom, weight = ScalePlan(1.0, 1.0) if settings.training else scale_plan(view, settings.trained_focal)
    base = images["base_rgb"]
    if zoom == 1.0:
        images["rgb"] = compensate(head, base, splatted, background)
    elif weight > 0:
        at_scale, _ = render_view(source, view.zoomed(zoom), background, settings, depth=False)
        correction = at_scale["rgb"] - at_scale["base_rgb"]
        images["rgb"] = base + weight * resize(correction, view.height, view.width)
    if not settings.training:
        images["rgb"] = images["rgb"].clamp(0.0, 1.0)
    return images, splatted
