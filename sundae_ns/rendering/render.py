"""How a field becomes pictures of a view: colours, one splatting pass, and the head's correction. Nothing is remembered."""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from sundae_ns.compensation import CompensationHead, ScalePlan, over_phases, plan, resize
from sundae_ns.distributed import Arrived
from sundae_ns.errors import DataError
from sundae_ns.gaussians import FEATURES
from sundae_ns.gaussians.parameters import sh_degree
from sundae_ns.pruning import pixel_detail
from sundae_ns.rasterization import Backend, Rasterization, blending_weights, rasterize, spherical_harmonics
from sundae_ns.rasterization.sharded import Route
from sundae_ns.rendering.views import View

NEAR_PLANE = 0.01


class Arrivals(Protocol):
    """What a view needs of primitives that several ranks hold."""

    def __call__(self, params: Mapping[str, Tensor], view: View, *, features: bool = ...) -> Arrived:
        """The primitives of all ranks that the view may see, from this rank's own. Collective."""


@dataclass(frozen=True)
class Style:
    """What pictures depend on beside field and view."""

    backend: Backend
    antialiased: bool = False
    """Whether opacities make up for the least size of footprints (``rasterize_mode`` of splatfacto)."""
    logits: bool = False
    """Whether band 0 holds logits of colours, and there are no others."""
    most_bands: int | None = None
    """Highest degree of the harmonics that takes part so far; None for all that there are."""
    training: bool = False
    """Whether the pictures are to be learned from: gradients are not cut off, and the head looks at what it is given."""
    absgrad: bool = False
    """Whether gradients of centres in the picture are summed by their absolute values too."""
    head: CompensationHead | None = None
    """None where no head takes part."""
    trained_focal: tuple[float, float] | None = None
    """Shortest and longest focal length, pixels, of the pictures that the head was trained on."""
    arrivals: Arrivals | None = None
    """Fetches primitives from other ranks; None where one process holds them all."""
    follow: Callable[[MutableMapping[str, Any], Route], None] | None = None
    """Told of ``info`` and route of what was fetched, before the backward pass, where ranks densify."""


def degree_in_use(features_rest: Tensor, most_bands: int | None) -> int:
    """Degree of the harmonics that pictures are made with.

    Args:
        features_rest: bands 1 and up ``[N, K, 3]``.
        most_bands: highest degree that takes part so far; None for all that there are.
    """
    degree = sh_degree(features_rest)
    return degree if most_bands is None else min(most_bands, degree)


def colors_of(params: Mapping[str, Tensor], center: Tensor, style: Style) -> Tensor:
    """Colours ``[N, 3]`` of the primitives as seen from a place ``[3]``, or from one each ``[N, 3]``."""
    if style.logits:
        return params["features_dc"].sigmoid()
    degree = degree_in_use(params["features_rest"], style.most_bands)
    coeffs = torch.cat([params["features_dc"][:, None], params["features_rest"]], dim=1)
    return (spherical_harmonics(degree, params["means"] - center, coeffs, backend=style.backend) + 0.5).clamp_min(0)


def _pass(params: Mapping[str, Tensor], view: View, style: Style) -> dict[str, Any]:
    """What every pass over a view tells the rasteriser: how primitives lie, and how they are seen."""
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
        "antialiased": style.antialiased,
        "backend": style.backend,
    }


def splat(params: Mapping[str, Tensor], view: View, channels: Tensor, style: Style, **options: Any) -> Rasterization:
    """Splat values of the primitives ``[N, C]``; options are those of ``rasterize``."""
    return rasterize(colors=channels, **_pass(params, view, style), **options)


def plan_of(view: View, trained_focal: tuple[float, float] | None) -> ScalePlan:
    """How a view's picture is compensated by a head that was trained at these focal lengths."""
    return plan(view.focal, trained_focal, view.width * view.height)


def render(
    params: Mapping[str, Tensor],
    view: View,
    background: Tensor,
    style: Style,
    *,
    depth: bool = True,
    compensate: bool = True,
) -> tuple[dict[str, Any], Rasterization]:
    """The pictures of one view: one splatting pass for colours, features and depth, then the head.

    Args:
        params: the field, or a part of it; with ranks, this rank's, or what has arrived.
        view: the camera.
        background: ``[3]`` colour behind everything.
        style: all else.
        depth: whether to render depth.
        compensate: whether the head may take part.

    Returns:
        ``rgb, base_rgb, depth, accumulation, feature_image``, each ``[H, W, C]``, and the rasteriser's result.
    """
    field, head = params, style.head if compensate else None
    if style.arrivals is not None and not isinstance(params, Arrived):
        params = style.arrivals(params, view, features=head is not None)
    channels = params["colors"] if isinstance(params, Arrived) else colors_of(params, view.center, style)
    if head is not None:
        channels = torch.cat([channels, params[FEATURES]], dim=1)
    splatted = splat(params, view, channels, style, render_depth=depth, absgrad=style.absgrad)
    blended, features = splatted.colors[..., :3], splatted.colors[..., 3:]
    base = (blended + (1 - splatted.alpha) * background).clamp(0.0, 1.0)
    rgb = base
    if head is not None:
        zoom, weight = ScalePlan(1.0, 1.0) if style.training else plan_of(view, style.trained_focal)
        if zoom == 1.0:
            seen = (base, splatted.colors, splatted.alpha)
            rgb = head(*seen) if style.training else over_phases(head, *seen)
            if head.config.mode == "features":
                # It knows neither background nor accumulation, and would show something where nothing is.
                rgb = splatted.alpha * rgb + (1 - splatted.alpha) * background
        elif weight > 0:
            at_scale, _ = render(field, view.zoomed(zoom), background, style, depth=False)
            correction = at_scale["rgb"] - at_scale["base_rgb"]
            rgb = base + weight * resize(correction, view.height, view.width)
        if not style.training:
            rgb = rgb.clamp(0.0, 1.0)
    pictures = {
        "rgb": rgb,
        "base_rgb": base,
        "depth": splatted.depth,
        "accumulation": splatted.alpha,
        "feature_image": features,
    }
    if style.follow is not None and isinstance(params, Arrived):
        style.follow(splatted.info, params.route)
    return pictures, splatted


def weights_of(
    params: Mapping[str, Tensor],
    view: View,
    background: Tensor,
    style: Style,
    keep_ratio: float | None = None,
    mask: Tensor | None = None,
) -> Tensor:
    """Blending weight of each primitive, summed over the pixels of one view ``[N]``.

    Args:
        params: the field; with ranks, what has arrived.
        view: the camera.
        background: ``[3]`` colour behind everything.
        style: how pictures are made.
        keep_ratio: share of the primitives that will stay; given, pixels count by the detail that so many can show.
        mask: the pixels that count at all, bool ``[H, W, 1]``; None for all.

    Raises:
        DataError: the mask has another size than the view.
    """
    if mask is not None and tuple(mask.shape) != (view.height, view.width, 1):
        raise DataError(
            f"a mask is {list(mask.shape)} where its view is {view.width} x {view.height} px; "
            "make masks of their pictures' sizes"
        )
    pixels = None
    if keep_ratio is not None:
        background = background.to(params["means"].device)
        pictures, splatted = render(params, view, background, style, depth=False, compensate=False)
        pixels = pixel_detail(pictures["base_rgb"], keep_ratio * float((splatted.radii > 0).sum()))
    if mask is not None:
        counts = mask[..., 0].to(params["means"])
        pixels = counts if pixels is None else pixels * counts
    return blending_weights(pixels=pixels, **_pass(params, view, style))
