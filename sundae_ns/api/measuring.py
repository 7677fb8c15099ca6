"""Quality of a scene against photographs, or against another scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
from torch import Tensor

from sundae_ns.api.rendering import render
from sundae_ns.api.scene import Scene
from sundae_ns.errors import DataError
from sundae_ns.evaluation import psnr, ssim
from sundae_ns.rasterization import BackendName
from sundae_ns.rendering import View


@dataclass(frozen=True)
class Quality:
    """Quality of images, a value for each view."""

    psnrs: tuple[float, ...]
    """Peak signal-to-noise ratio over all pixels and channels, dB."""
    ssims: tuple[float, ...]
    """Structural similarity, window of 11 x 11 pixels without padding; NaN for smaller images."""

    @property
    def psnr(self) -> float:
        """Mean PSNR over the views, dB."""
        return fmean(self.psnrs)

    @property
    def ssim(self) -> float:
        """Mean SSIM over the views."""
        return fmean(self.ssims)


@torch.no_grad()
def measure(
    scene: Scene,
    reference: Scene | Sequence[Tensor],
    views: Sequence[View] | None = None,
    *,
    head: bool = True,
    backend: BackendName = "auto",
) -> Quality:
    """Compare the images of a scene with a reference.

    Args:
        scene: to measure.
        reference: a scene, whose own images count as true, or an image in [0, 1] ``[H, W, 3]`` for each view. Both
            scenes are rendered over the background of the reference.
        views: the cameras; by default those stored with the reference, or with the scene.
        head: whether the heads of both scenes correct their images.
        backend: the rasteriser.

    Raises:
        DataError: there are no views, or not one image of its size for each view.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(200, 3), torch.rand(200, 3))
    >>> views = sn.virtual_views(scene, 2, size=32)
    >>> sn.measure(sn.prune(scene, keep=0.5, views=views), scene, views).psnr > 10
    True
    """
    stored = reference.views if isinstance(reference, Scene) else ()
    views = tuple(views) if views is not None else stored or scene.views
    if not views:
        raise DataError("there is no view to measure in; give views, such as sundae_ns.virtual_views(scene)")
    if not isinstance(reference, Scene) and len(reference) != len(views):
        raise DataError(f"{len(reference)} images do not fit {len(views)} views; give one image for each view")
    if isinstance(reference, Scene):
        scene = dataclasses.replace(scene, background_color=reference.background_color)
    found = []
    for i, view in enumerate(views):
        image = render(scene, view, head=head, backend=backend).rgb
        true = render(reference, view, head=head, backend=backend).rgb if isinstance(reference, Scene) else reference[i]
        true = true.to(image)
        found.append((float(psnr(image, true)), float(ssim(image, true))))
    psnrs, ssims = zip(*found, strict=True)
    return Quality(psnrs, ssims)
