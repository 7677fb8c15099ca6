"""Image metrics, each in one named variant."""

from __future__ import annotations

import logging
import urllib.request
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, Literal, TypeVar

import torch
from pytorch_msssim import ssim as windowed_ssim
from torch import Tensor

from sundae_ns.core.errors import DataError, one_line

SSIM_WINDOW = 11  # side of SSIM's Gaussian window, pixels (Wang et al. 2004)
MOST_PSNR = 100.0  # highest PSNR that a decision or a fit of colours gives, dB; 8-bit images carry no more
AnyCamera = TypeVar("AnyCamera")
Net = Literal["alex", "vgg", "squeeze"]
_log = logging.getLogger(__name__)


def check_pair(pred: Tensor, target: Tensor) -> None:
    """Raise DataError unless both are images ``[H, W, 3]`` of one size."""
    if pred.shape != target.shape or pred.dim() != 3 or pred.shape[-1] != 3:
        raise DataError(f"images have shapes {[*pred.shape]} and {[*target.shape]}; give two of one size, [H, W, 3]")


def psnr(pred: Tensor, target: Tensor) -> Tensor:
    """Peak signal-to-noise ratio ``-10 log10(MSE)`` over all values of images ``[H, W, 3]`` in [0, 1], dB ``[]``."""
    check_pair(pred, target)
    return -10 * torch.log10(torch.mean((pred - target) ** 2))


@torch.no_grad()
def fitted_psnr(pred: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """PSNR after the affine map of colours (12 numbers) that brings an image nearest to its target.

    ``mask`` has the pixels that count, bool ``[H, W]``. At most :data:`MOST_PSNR`; NaN if the image is not finite.
    """
    check_pair(pred, target)
    chosen = ... if mask is None else mask
    colors, truth = pred[chosen].reshape(-1, 3).double(), target[chosen].reshape(-1, 3).double()
    if not bool(torch.isfinite(colors).all()):
        return colors.new_full((), float("nan"))
    rows = torch.cat([colors, torch.ones_like(colors[:, :1])], dim=1)
    # A ridge far below 8-bit steps keeps images of one colour solvable.
    normal = rows.T @ rows + 1e-6 * len(rows) * torch.eye(4, dtype=rows.dtype, device=rows.device)
    error = rows @ torch.linalg.solve(normal, rows.T @ truth) - truth
    return (-10 * error.square().mean().clamp_min(1e-30).log10()).clamp_max(MOST_PSNR)


def ssim(pred: Tensor, target: Tensor) -> Tensor:
    """Structural similarity (Wang et al. 2004) as in splatfacto; NaN if a side is shorter than the window.

    By pytorch_msssim: an 11 x 11 Gaussian window with sigma 1.5, no padding, averaged over pixels and channels.
    """
    check_pair(pred, target)
    if min(pred.shape[:2]) < SSIM_WINDOW:
        return pred.new_full((), float("nan"))
    return windowed_ssim(pred.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None], data_range=1.0)


def lpips_weights(net: Net = "alex") -> tuple[str, Path]:
    """URL of torchvision's weights of a backbone, and the file in which torch.hub caches them."""
    from torchvision import models

    names = {"alex": "AlexNet_Weights", "vgg": "VGG16_Weights", "squeeze": "SqueezeNet1_1_Weights"}
    url = getattr(models, names[net]).DEFAULT.url
    return url, Path(torch.hub.get_dir()) / "checkpoints" / url.rpartition("/")[2]


class Lpips:
    """Learned perceptual image patch similarity (Zhang et al. 2018), built at its first use, which downloads weights.

    torchmetrics' variant with ``normalize=True``. Values of different nets do not compare: most papers report VGG,
    splatfacto and gsplat report AlexNet. No ``nn.Module``, so that checkpoints do not hold the net.
    """

    def __init__(self, net: Net = "alex") -> None:
        self.net: Net = net
        self._metric: Any = None
        self._failed = False

    @torch.no_grad()
    def __call__(self, pred: Tensor, target: Tensor) -> Tensor | None:
        """Distance of two images ``[H, W, 3]``; None if a side is shorter than 32 pixels, or without weights."""
        check_pair(pred, target)
        if self._failed or min(pred.shape[:2]) < 32:
            return None
        if self._metric is None:
            url, path = lpips_weights(self.net)
            try:
                if not path.is_file():  # torch.hub downloads without a time limit: ask first whether the server answers
                    urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=5).close()
                from torchmetrics.image import LearnedPerceptualImagePatchSimilarity

                self._metric = LearnedPerceptualImagePatchSimilarity(net_type=self.net, normalize=True)
            except Exception as error:  # network, disk or a damaged file: a missing metric must not end a run
                self._failed = True
                cause = f"its {self.net} weights are missing ({one_line(error)})"
                _log.warning("LPIPS is left out because %s; put %s into %s.", cause, url, path.parent)
                return None
        # Calling the metric returns the value of this pair alone; earlier calls do not count.
        return self._metric.to(pred.device)(*(x.float().clamp(0, 1).permute(2, 0, 1)[None] for x in (pred, target)))


@dataclass(frozen=True)
class Quality:
    """PSNR and SSIM of images: a value for each camera, and their means."""

    psnrs: tuple[float, ...]
    """Peak signal-to-noise ratio over all pixels and channels, dB."""
    ssims: tuple[float, ...]
    """Structural similarity, window of 11 x 11 pixels without padding; NaN for smaller images."""

    @property
    def psnr(self) -> float:
        """Mean PSNR over the cameras, dB."""
        return fmean(self.psnrs)

    @property
    def ssim(self) -> float:
        """Mean SSIM over the cameras."""
        return fmean(self.ssims)


@torch.no_grad()
def evaluate(render: Callable[[AnyCamera], Tensor], cameras: Iterable[AnyCamera], targets: Iterable[Tensor]) -> Quality:
    """Compare the images ``[H, W, 3]`` that ``render`` gives for cameras, at least one, with true ones in [0, 1]."""
    pairs = ((render(camera), target) for camera, target in zip(cameras, targets, strict=True))
    values = [[float(metric(image, target.to(image))) for metric in (psnr, ssim)] for image, target in pairs]
    return Quality(*zip(*values, strict=True))


@dataclass(frozen=True)
class ViewQuality:
    """Metrics of one image; None is a metric that was not measured."""

    psnr: float  # dB
    ssim: float  # NaN for images smaller than its window
    lpips: float | None = None
    psnr_fitted: float | None = None  # dB, by fitted_psnr


def quality_of(image: Tensor, truth: Tensor, lpips: Callable[[Tensor, Tensor], Any] | None = None) -> ViewQuality:
    """Every metric of an image ``[H, W, 3]`` against its truth."""
    metrics: dict[str, Any] = {"psnr": psnr, "psnr_fitted": fitted_psnr, "ssim": ssim, "lpips": lpips}
    values = {name: metric(image, truth) for name, metric in metrics.items() if metric is not None}
    return ViewQuality(**{name: float(value) for name, value in values.items() if value is not None})
