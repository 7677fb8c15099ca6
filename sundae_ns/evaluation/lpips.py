"""LPIPS that costs nothing until it is asked for, and fails nothing where its weights cannot be had."""

from __future__ import annotations

import logging
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from sundae_ns.evaluation.metrics import check_pair

if TYPE_CHECKING:
    from torchmetrics.image import LearnedPerceptualImagePatchSimilarity

logger = logging.getLogger(__name__)

Net = Literal["alex", "vgg", "squeeze"]

MIN_SIDE = 32
"""Pixels a side below which a backbone pools its input away."""

PROBE_SECONDS = 5.0
"""How long the server of the weights may take to answer before it counts as out of reach."""

_BACKBONES = {"alex": "AlexNet_Weights", "vgg": "VGG16_Weights", "squeeze": "SqueezeNet1_1_Weights"}


def lpips_weights_url(net: Net = "alex") -> str:
    """Where torchvision takes a backbone's weights from. (The linear layers on top come with torchmetrics.)"""
    from torchvision import models

    return getattr(models, _BACKBONES[net]).DEFAULT.url


def lpips_weights_path(net: Net = "alex") -> Path:
    """The file in which torch.hub keeps a backbone's weights; it need not exist."""
    return Path(torch.hub.get_dir()) / "checkpoints" / lpips_weights_url(net).rpartition("/")[2]


def lpips_weights_available(net: Net = "alex") -> bool:
    """Whether LPIPS can be computed here without a download."""
    return lpips_weights_path(net).is_file()


class Lpips:
    """Learned perceptual image patch similarity (Zhang et al. 2018), built at its first use.

    torchmetrics' variant with ``normalize=True``: it takes pictures in [0, 1]. The values of different nets cannot be
    compared: papers mostly print VGG, splatfacto and gsplat AlexNet. No ``nn.Module``, so that the net's weights stay
    out of checkpoints.

    Args:
        net: backbone: ``alex``, ``vgg`` or ``squeeze``.
        download: whether weights that are not on disk may be fetched.
    """

    def __init__(self, net: Net = "alex", *, download: bool = True) -> None:
        self.net: Net = net
        self.download = download
        self._metric: LearnedPerceptualImagePatchSimilarity | None = None
        self._failed = False

    @torch.no_grad()
    def __call__(self, pred: Tensor, target: Tensor) -> Tensor | None:
        """Distance of two pictures; smaller is better.

        Args:
            pred: ``[H, W, 3]``; clamped to [0, 1].
            target: ``[H, W, 3]``; clamped to [0, 1].

        Returns:
            A float32 scalar on the inputs' device; None where a side is shorter than 32 pixels, or where the weights
            cannot be had, of which one warning tells.

        Raises:
            DataError: the shapes differ, or are not those of pictures.
        """
        check_pair(pred, target)
        if min(pred.shape[:2]) < MIN_SIDE:
            return None
        metric = self._built()
        if metric is None:
            return None
        metric.to(pred.device)
        # Called, a metric of torchmetrics answers for this pair alone, whatever it has seen before.
        return metric(*(picture.float().clamp(0, 1).permute(2, 0, 1)[None] for picture in (pred, target)))

    def _built(self) -> LearnedPerceptualImagePatchSimilarity | None:
        if self._metric is not None or self._failed:
            return self._metric
        try:
            if not lpips_weights_available(self.net):
                if not self.download:
                    raise FileNotFoundError("downloads are off")
                # Torch's own download waits without limit: ask first whether anybody answers.
                probe = urllib.request.Request(lpips_weights_url(self.net), method="HEAD")
                urllib.request.urlopen(probe, timeout=PROBE_SECONDS).close()
            from torchmetrics.image import LearnedPerceptualImagePatchSimilarity

            self._metric = LearnedPerceptualImagePatchSimilarity(net_type=self.net, normalize=True)
        except Exception as error:
            # Whatever went wrong (network, disk, a damaged file): a metric that is missing must not end a run.
            self._failed = True
            cause = " ".join(str(error).split()) or type(error).__name__
            logger.warning(
                "LPIPS is left out, for its %s weights cannot be had (%s); put %s into %s.",
                self.net,
                cause,
                lpips_weights_url(self.net),
                lpips_weights_path(self.net).parent,
            )
        return self._metric
