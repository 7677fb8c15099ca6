"""From Gaussians to the images of a view: colours, one splatting pass, the head's correction; and what views see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import DataError
from sundae_ns.core.gaussians import FEATURES, MAX_SH_DEGREE, Gaussians
from sundae_ns.head.head import CompensationHead, ScalePlan, plan, resize
from sundae_ns.pruning.scores import pixel_detail
from sundae_ns.rasterize.interface import blending_weights, harmonic_colors, rasterize, two_at_once
from sundae_ns.rasterize.reference import BLUR, FOV_MARGIN
from sundae_ns.rasterize.types import Backend, Inputs, Rasterization, check_memory

if TYPE_CHECKING:
    from rich.console import Console

SHOWN_BACKGROUNDS = {"random": (0.1490, 0.1647, 0.2157), "black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
"""Backgrounds of images that are not trained on, by the option ``background_color``; for random the viewer's."""
NEAR_PLANE = 0.01  # distance of the near plane, world units


@dataclass(frozen=True)
class RenderSettings:
    """Everything that an image depends on beside Gaussians and camera."""

    backend: Backend
    active_sh_degree: int = MAX_SH_DEGREE  # Highest SH degree in use, at most that of the Gaussians
    fixed_harmonics: bool = False  # Whether the harmonics beyond the base colour get no gradient
    antialiased: bool = False  # Whether opacities compensate for the smallest footprint (splatfacto's rasterize_mode)
    training: bool = False  # Whether gradients are needed: images are not clamped, and the head runs at their scale
    drop_rate: float = 0.0  # Share of the Gaussians that are left out at random
    absgrad: bool = False  # Whether to sum absolute gradients of the projected centres
    head: CompensationHead | None = None  # The head; None while it is disabled
    trained_focal: tuple[float, float] | None = None  # Shortest and longest focal length of the head's images, pixels
    near_plane: float = NEAR_PLANE  # Gaussians with a smaller camera z are not drawn, world units


def colors_from(params: Mapping[str, Tensor], gaussians: Gaussians, center: Tensor, settings: RenderSettings) -> Tensor:
    """Colours of Gaussians as seen from a camera centre ``[3]``, or one for each ``[M, 3]``; at least 0 ``[M, 3]``.

    ``params`` has ``means``, ``features_dc`` and ``features_rest`` of M of the ``gaussians``, which give the encoding.
    """
    if gaussians.encoding == "logits":
        return params["features_dc"].sigmoid()
    rest = params["features_rest"].detach() if settings.fixed_harmonics else params["features_rest"]
    values = params["means"], center, params["features_dc"], rest
    return harmonic_colors(min(gaussians.sh_degree, settings.active_sh_degree), *values, backend=settings.backend)


class GaussianSource:
    """The Gaussians of one process. Those that are not ``replayable``, a share, are new tensors each time."""

    def __init__(self, gaussians: Gaussians, *, replayable: bool = True) -> None:
        self.gaussians = gaussians
        self.replayable = replayable

    @property
    def total(self) -> int:
        """Number of Gaussians in all processes."""
        return self.gaussians.num_gaussians

    def primitives(self, camera: Camera, settings: RenderSettings, *, features: bool) -> dict[str, Tensor]:
        """Parameters of the Gaussians that the view may see ``[M, ...]``, with ``colors`` from its camera ``[M, 3]``.

        ``features`` says whether feature vectors are needed.
        """
        return {**self.gaussians, "colors": colors_from(self.gaussians, self.gaussians, camera.center, settings)}


def pass_inputs(
    params: Mapping[str, Tensor], camera: Camera, settings: RenderSettings, channels: Tensor | None = None, **extra: Any
) -> Inputs:
    """Arguments of a splatting pass: activated parameters, channels ``[N, C]`` or 1, camera, settings, and others."""
    colors = torch.ones_like(params["means"][:, :1]) if channels is None else channels
    opacities = params["opacities"].sigmoid().squeeze(-1)
    if settings.drop_rate > 0:  # The others make up for them (Park et al., "DropGaussian", 2025)
        opacities = torch.nn.functional.dropout(opacities, settings.drop_rate).clamp(max=1)
    splats = (params["means"], params["quats"], params["scales"].exp(), opacities, colors)
    return Inputs(*splats, camera, near_plane=settings.near_plane, antialiased=settings.antialiased, **extra)


def splat(
    params: Mapping[str, Tensor], camera: Camera, channels: Tensor, settings: RenderSettings, **options: Any
) -> Rasterization:
    """Splat values of the Gaussians ``[N, C]``; arguments are those of :func:`pass_inputs`."""
    return rasterize(pass_inputs(params, camera, settings, channels, **options), backend=settings.backend)


def scale_plan(camera: Camera, trained_focal: tuple[float, float] | None) -> ScalePlan:
    """Scale and strength of the correction for a view, given the focal lengths that the head was trained at."""
    return plan(camera.focal, trained_focal, camera.width * camera.height)


def draw(
    primitives: Mapping[str, Tensor], camera: Camera, background: Tensor, settings: RenderSettings, *, depth: bool
) -> tuple[dict[str, Any], Rasterization]:
    """Splat colours, features if the head is enabled, and depth in one pass: the images of :func:`render_view`."""
    colors = primitives["colors"]
    channels = colors if settings.head is None else torch.cat([colors, primitives[FEATURES]], dim=1)
    splatted = splat(primitives, camera, channels, settings, render_depth=depth, absgrad=settings.absgrad)
    base = (splatted.colors[..., :3] + (1 - splatted.alpha) * background).clamp(0.0, 1.0)
    return {"rgb": base, "base_rgb": base, "depth": splatted.depth, "accumulation": splatted.alpha}, splatted


def compensate(head: CompensationHead, base: Tensor, splatted: Rasterization, background: Tensor) -> Tensor:
    """The corrected image of one splatting pass ``[H, W, 3]``, not clamped. Only this function runs the head."""
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
    source: GaussianSource, camera: Camera, background: Tensor, settings: RenderSettings, *, depth: bool = True
) -> tuple[dict[str, Any], Rasterization]:
    """The images of one view over a background ``[3]``: Gaussians, one splatting pass, and the head.

    They are ``rgb, base_rgb, depth, accumulation``, each ``[H, W, C]``, beside the rasteriser's result.
    One of another scale than the head was trained at gets the resized correction of that (:mod:`sundae_ns.head.head`).
    """
    head = settings.head
    primitives = source.primitives(camera, settings, features=head is not None)
    images, splatted = draw(primitives, camera, background, settings, depth=depth)
    if head is None:
        return images, splatted
    zoom, weight = ScalePlan(1.0, 1.0) if settings.training else scale_plan(camera, settings.trained_focal)
    base = images["base_rgb"]
    if zoom == 1.0:
        images["rgb"] = compensate(head, base, splatted, background)
    elif weight > 0:
        at_scale, _ = render_view(source, camera.zoomed(zoom), background, settings, depth=False)
        images["rgb"] = base + weight * resize(at_scale["rgb"] - at_scale["base_rgb"], camera.height, camera.width)
    if not settings.training:
        images["rgb"] = images["rgb"].clamp(0.0, 1.0)
    return images, splatted


def may_be_seen(means: Tensor, largest: Tensor, viewmats: Tensor, Ks: Tensor, sizes: Tensor) -> Tensor:
    """Conservative visibility: True for all Gaussians that a backend renders, and some others; bool ``[R, N]``.

    With the largest scale s, depth z and slope k of a pixel, clamped to the image and a margin, the perspective map's
    Jacobian has rows of length ``f / z * sqrt(1 + k^2)``: a radius is at most ``3 s C / z`` with one C a camera, plus
    the blur. Takes centres ``[N, 3]``, largest deviations ``[N]``, viewmats, intrinsics and sizes ``[R, 2]``, pixels.
    """
    off_axis = Ks[:, :2, 2] - sizes / 2
    limit = off_axis.abs() + (0.5 + 0.5 * FOV_MARGIN) * sizes
    # Slightly more than 3, for rounding.
    reach = 3.003 * (Ks[:, :2, :2].square().sum(dim=(1, 2)) + limit.square().sum(dim=1)).sqrt()[:, None]
    # From the middle of the image: half the size, the blur, the rounding up of the radius, and a pixel for errors.
    sides = torch.cat([Ks[:, :2], -Ks[:, :2]], dim=1)
    sides[:, :, 2] = torch.cat([off_axis, -off_axis], dim=1) - (sizes / 2 + 3 * (2 * BLUR) ** 0.5 + 2).repeat(1, 2)
    planes = sides @ viewmats[:, :3]  # [R, 4, 4]: how far beyond each side, times z
    beyond = torch.addmm(planes[..., 3].reshape(-1, 1), planes[..., :3].flatten(0, 1), means.T).unflatten(0, (-1, 4))
    # NaN compares as visible in the sides, where backends disagree, but not in depth, where none renders it.
    return (viewmats[:, 2, :3] @ means.T + viewmats[:, 2, 3:] >= NEAR_PLANE) & ~(beyond.amax(dim=1) > largest * reach)


@torch.no_grad()
def contribution(
    source: GaussianSource,
    cameras: Sequence[tuple[Camera, Tensor | None]],
    background: Tensor,
    settings: RenderSettings,
    count: int | None = None,
    *,
    images: list[Tensor] | None = None,
    console: Console | None = None,
) -> Tensor:
    """Blending weight of each Gaussian over a fixed background, summed over the pixels of all views ``[N]``.

    Cameras come with a mask of the pixels that count, bool ``[H, W, 1]`` (else ``DataError``), or None. With ``count``,
    the number of Gaussians that a prune will keep, :func:`.pixel_detail` that these cannot show weighs the pixels, and
    blended colours and accumulation of each view, float16 ``[H, W, 4]``, are appended to ``images``.
    """
    from rich.progress import track  # takes 20 ms, which a render without a prune need not spend

    total = source.gaussians["means"].new_zeros(source.gaussians.num_gaussians)
    largest = source.gaussians["scales"].amax(dim=1).exp()

    def of_view(view: tuple[Camera, Tensor | None]) -> tuple[Any, Tensor, Any]:  # rows, their weights, and the image
        camera, mask = view
        if mask is not None and tuple(mask.shape) != (camera.height, camera.width, 1):
            size = f"{camera.width} x {camera.height}"
            raise DataError(f"a mask is {list(mask.shape)} but its view is {size} px; give masks of their images' size")
        rows: Any = ...
        if total.is_cpu:  # a GPU culls faster than it picks rows
            pose = camera.viewmat[None], camera.K[None], torch.tensor([[camera.width, camera.height]])
            rows = may_be_seen(source.gaussians["means"], largest, *pose)[0].nonzero().squeeze(1)
        visible = GaussianSource(source.gaussians.rows(rows)) if total.is_cpu else source
        pixels = None if mask is None else mask[..., 0].to(total)
        if count is None:
            inputs = pass_inputs(visible.gaussians, camera, settings)
            return rows, blending_weights(inputs, pixels, backend=settings.backend), None
        # As in blending_weights, but one pass gives the image and the weights: the gradient of the first channel.
        fixed = {name: value.detach() for name, value in visible.primitives(camera, settings, features=False).items()}
        colors = fixed["colors"].requires_grad_()
        with torch.enable_grad():
            drawn, splatted = draw(fixed, camera, background.to(total), replace(settings, head=None), depth=False)
            # A prune keeps the same share of the visible Gaussians as of all.
            detail = pixel_detail(drawn["base_rgb"].detach(), count / source.total * float((splatted.radii > 0).sum()))
            blended = (splatted.colors[..., 0] * (detail if pixels is None else detail * pixels)).sum()
        image = None if images is None else torch.cat([splatted.colors.detach(), splatted.alpha.detach()], dim=2).half()
        return rows, torch.autograd.grad(blended, colors)[0][:, 0], image

    views = (two_at_once if total.is_cpu else map)(of_view, cameras)
    bar: dict[str, Any] = {"console": console, "transient": True, "disable": not (console and console.is_terminal)}
    for rows, new, image in track(views, "Contribution of Gaussians", len(cameras), **bar):
        total[rows] += new
        if images is not None and count is not None:  # only a pass that weights by detail renders the image
            images.append(image)
    return total
