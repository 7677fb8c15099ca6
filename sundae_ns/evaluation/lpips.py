"""LPIPS, built at its first use and left out with a warning if its weights are missing."""

from __future__ import annotations

import logging
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from sundae_ns.errors import one_line
from sundae_ns.evaluation.metrics import check_pair

if TYPE_CHECKING:
    from torchmetrics.image import LearnedPerceptualImagePatchSimilarity

logger = logging.getLogger(__name__)

Net = Literal["alex", "vgg", "squeeze"]
_MIN_SIDE = 32
"""Shortest image side in pixels; below it, a backbone pools its input to nothing."""
_PROBE_SECONDS = 5.0
"""Seconds to wait for the server of the weights."""
_BACKBONES = {"alex": "AlexNet_Weights", "vgg": "VGG16_Weights", "squeeze": "SqueezeNet1_1_Weights"}


def lpips_weights_url(net: Net = "alex") -> str:
    """URL of torchvision's weights of a backbone. torchmetrics ships the linear layers on top."""
    from torchvision import models

    return getattr(models, _BACKBONES[net]).DEFAULT.url


def lpips_weights_path(net: Net = "alex") -> Path:
    """Path at which torch.hub caches a backbone's weights; the file may not exist yet."""
    return Path(torch.hub.get_dir()) / "checkpoints" / lpips_weights_url(net).rpartition("/")[2]


def lpips_weights_available(net: Net = "alex") -> bool:
    """Whether the weights are on disk, so that LPIPS needs no download."""
    return lpips_weights_path(net).is_file()


class Lpips:
    """Learned perceptual image patch similarity (Zhang et al. 2018), built at its first use.

    torchmetrics' variant with ``normalize=True``, for images in [0, 1]. Values of different nets do not compare: most
    papers report VGG, splatfacto and gsplat report AlexNet. It is no ``nn.Module``, so checkpoints do not hold the net.

    Args:
        net: the backbone, ``alex``, ``vgg`` or ``squeeze``.
        download: whether missing weights may be downloaded.
    """

    def __init__(self, net: Net = "alex", *, download: bool = True) -> None:
        self.net: Net = net
        self.download = download
        self._metric: LearnedPerceptualImagePatchSimilarity | None = None
        self._failed = False

    @torch.no_grad()
    def __call__(self, pred: Tensor, target: Tensor) -> Tensor | None:
        """Distance of two images ``[H, W, 3]``, clamped to [0, 1]; lower is better.

        Returns:
            A float32 scalar on the inputs' device. None if a side is shorter than 32 pixels, or if the weights are
            missing; the first such call logs a warning.

        Raises:
            DataError: the shapes differ, or are not ``[H, W, 3]``.
        """
        check_pair(pred, target)
        if min(pred.shape[:2]) < _MIN_SIDE:
            return None
        if self._metric is None and not self._failed:
            self._build()
        if self._metric is None:
            return None
        self._metric.to(pred.device)
        # Calling the metric returns the value of this pair alone; earlier calls do not count.
        return self._metric(*(image.float().clamp(0, 1).permute(2, 0, 1)[None] for image in (pred, target)))

    def _build(self) -> None:
        try:
            if not lpips_weights_available(self.net):
                if not self.download:
                    raise FileNotFoundError("downloads are off")
                # torch.hub downloads without a timeout, so check first that the server answers.
                probe = urllib.request.Request(lpips_weights_url(self.net), method="HEAD")
                urllib.request.urlopen(probe, timeout=_PROBE_SECONDS).close()
            from torchmetrics.image import LearnedPerceptualImagePatchSimilarity

            self._metric = LearnedPerceptualImagePatchSimilarity(net_type=self.net, normalize=True)
        except Exception as error:
            # Network, disk or a damaged file: a missing metric must not end a run.
            self._failed = True
            url, folder = lpips_weights_url(self.net), lpips_weights_path(self.net).parent
            cause = f"its {self.net} weights are missing ({one_line(error)})"
            logger.warning("LPIPS is left out because %s; put %s into %s.", cause, url, folder)
