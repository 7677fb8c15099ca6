"""The compensation head: from splatted colours, features and accumulation to the final image.

Training sees random crops of large images (:func:`training_crop`), so the cost of a step does not grow with the image
size. A screen-space network learns one size of a pixel in the scene, and on an image of half or twice the focal length
it may do harm. Such images are compensated at the trained scale, and the correction is resized (:func:`plan`).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sundae_ns.core.camera import Crop
from sundae_ns.core.errors import BackendError, ConfigError
from sundae_ns.core.gaussians import bytes_of
from sundae_ns.head import fused
from sundae_ns.head.unet import UNet

SIZES: dict[str, tuple[int, int | None]]
SIZES = {"tiny": (8, None), "compact": (32, 64), "wide": (64, 64), "regular": (64, None)}
"""Channels of the finest level, and the maximum of the coarser ones. The last is the paper's."""
TOLERANCE = 1.01
"""Ratio of focal lengths up to which the head runs at the image's own scale: the difference between training and test
cameras. An image 2% larger or smaller is better with the correction of the trained scale."""
FADE = (4.0, 2.0)
"""Images shrunk by more than the first factor are shown without the head, those by less than the second with all of it:
a thumbnail must not cost a full-size image, nor the head appear abruptly during a zoom."""
MAX_PIXELS = 2**24
"""The head also fades out for images with more pixels than this at the trained scale, such as a wide view, unless they
are rescaled by less than ``MARGIN``. It is off at twice as many: 33 million pixels take two gigabytes."""
MARGIN = 1.25
GRID = 16  # sides of a training window are multiples of this many pixels, so that the U-Net needs no padding
PRECISIONS = {"fp32": torch.float32, "bf16": torch.bfloat16}

_log = logging.getLogger(__name__)


@dataclass
class HeadConfig:
    """Architecture and arithmetic of the compensation head."""

    mode: Literal["auto", "residual", "features", "off"] = "auto"
    """auto: residual, if held-out training views show after a short trial that it pays, else off. residual: the head
    adds a correction to the spherical-harmonics image, which remains usable alone. features: the paper's, the head
    alone makes the image from splatted features, over the background. off: no head."""
    size: Literal["tiny", "compact", "wide", "regular"] = "wide"
    """Width of the U-Net: 0.5, 2, 2.5 or 31 MB in fp32. regular is the paper's; compact and wide have at most 64
    channels on each level."""
    pixel_unshuffle: int = 2
    """Fold blocks of this many pixels per side into channels before the U-Net: 1 is the paper's, 2 is faster."""
    num_features: int = 13  # Length F of each Gaussian's feature vector. 1, 5, 13 and 29 splat without padding.
    start_at: int | None = None
    """Training step after which the head is enabled; by default the last prune. If it is enabled for the last few
    thousand steps only, base colours stay those of a field without a head: less flicker and less overfitting to few
    views, but also less gain."""
    max_train_pixels: int = 2**22
    """Train on a random window of at most this many pixels if images are larger, once the head is enabled; 0 for whole
    images."""
    precision: Literal["fp32", "bf16"] = "bf16"  # Arithmetic of the U-Net on CUDA; a CPU always uses fp32

    @property
    def resolved(self) -> HeadConfig:
        """The configuration of the head while it is undecided: residual in place of auto."""
        return replace(self, mode="residual") if self.mode == "auto" else self

    def validate(self) -> None:
        """Raise a ConfigError for the first value that is invalid."""
        for name, least, remedy in (
            ("num_features", 1, "set at least 1, or disable the head with head.mode off"),
            ("pixel_unshuffle", 1, "set 1, 2 or 4"),
            ("max_train_pixels", 0, "set 0 for whole images, or more"),
        ):
            if (value := getattr(self, name)) < least:
                raise ConfigError(f"head.{name.replace('_', '-')} is {value}; {remedy}")


class CompensationHead(nn.Module):
    """Computes the compensated image (``I_hat = Phi(F)`` of the paper, and our residual variant).

    Mode auto makes a residual head, off is refused; ``ConfigError`` for an invalid configuration.
    """

    def __init__(self, config: HeadConfig) -> None:
        super().__init__()
        self._build(config)

    @classmethod
    def of_weights(cls, config: HeadConfig, weights: Mapping[str, Tensor]) -> CompensationHead | None:
        """A head for evaluation with the weights of a ``state_dict``; None if they do not fit the configuration."""
        # A wide head takes memory and seconds, which a small file must not cause: compare the shapes first.
        with torch.device("meta"):
            fresh = cls(config).state_dict()
        if weights.keys() != fresh.keys() or any(value.shape != weights[name].shape for name, value in fresh.items()):
            return None
        head = cls(config)
        head.load_state_dict(weights)
        return head.eval()

    def _build(self, config: HeadConfig) -> None:
        config = config.resolved
        config.validate()
        if config.mode == "off":
            raise ConfigError("head.mode is off, which is no compensation head; choose residual or features")
        self.config = config
        # The residual head sees the colours and the accumulation beside the features.
        residual = config.mode == "residual"
        channels = config.num_features + (4 if residual else 0)
        width, most = SIZES[config.size]
        self.net = UNet(channels, 3, width, max_width=most, pixel_unshuffle=config.pixel_unshuffle, zero_init=residual)
        self.net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._can_fuse = True
        # Listed once, because every frame asks for the addresses and a walk over all layers takes 0.1 ms.
        self._weights = tuple(self.net.parameters())

    def addresses(self) -> tuple[int, ...]:
        """Addresses of the weights, which recorded frames read."""
        return tuple(value.data_ptr() for value in self._weights)

    def train(self, mode: bool = True) -> CompensationHead:
        """Switch between training and evaluation, which no layer distinguishes."""
        # Trainers call this at each step: skip the walk over all layers if nothing changes.
        return self if self.training == mode else super().train(mode)

    @torch.no_grad()
    def resize(self, config: HeadConfig) -> None:
        """Become a head of another size or feature width, with fresh weights.

        The parameters stay the same objects, so an optimizer keeps them; its state for them is stale.
        """
        parameters = list(self.parameters())
        self._build(config)
        fresh = [(module, name) for module in self.net.modules() for name in module._parameters]
        for parameter, (module, name) in zip(parameters, fresh, strict=True):
            parameter.data, parameter.grad = getattr(module, name).data.to(parameter), None
            setattr(module, name, parameter)
        self.net.train(self.training)
        self._weights = tuple(self.net.parameters())

    def forward(self, base: Tensor, splatted: Tensor, alpha: Tensor) -> Tensor:
        """Compensate one image; returns ``[H, W, 3]``, not clamped. All images are float32, on the head's device.

        ``base`` is the spherical-harmonics image over its background, in [0, 1] ``[H, W, 3]``. ``splatted`` ``[H, W, 3
        + F]`` are the same colours without background, so that the head does not depend on it, and the features. Where
        the accumulation ``alpha`` ``[H, W, 1]`` is 0, the residual head returns ``base``.
        """
        residual = self.config.mode == "residual"
        dtype = PRECISIONS[self.config.precision] if base.device.type == "cuda" else torch.float32
        if self._can_fuse and dtype != torch.float32:
            try:
                if not torch.is_grad_enabled():
                    return fused.compensated(self.net, residual, base, splatted, alpha, dtype)
                out = fused.correction(self.net, residual, splatted, alpha, dtype)
                return base + out if residual else out
            except BackendError as error:
                _log.warning("the head runs layer by layer, not with the kernels for %s: %s", base.device, error)
                self._can_fuse = False
        image = torch.cat([splatted[..., :3], alpha, splatted[..., 3:]], dim=-1) if residual else splatted[..., 3:]
        # [H, W, C] is the channels-last layout of [1, C, H, W]: no copy.
        with torch.autocast(image.device.type, dtype=dtype, enabled=dtype != torch.float32):
            out = self.net(image.permute(2, 0, 1)[None].to(dtype))[0].permute(1, 2, 0)
        return base + alpha * out.float() if residual else out.float()


def training_crop(width: int, height: int, max_pixels: int, seed: int, *, mirror: bool = False) -> Crop | None:
    """A random window with the image's aspect ratio, pixels, or None to train on the whole image, not mirrored.

    It has at most ``max_pixels``, but sides of at least :data:`GRID`; 0 for no limit. Positions are drawn from beyond
    the edges too and moved back inside, because uniform ones would rarely include the pixels next to the edges. The
    window is a function of the seed, as a resumed run uses the same; with ``mirror`` one of two is mirrored.
    """
    fits = max_pixels == 0 or width * height <= max_pixels
    if fits and not mirror:
        return None
    u, v, side = torch.rand(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float32).tolist()
    mirrored = mirror and side < 0.5
    if fits:
        return Crop(0, 0, width, height, mirrored) if mirrored else None
    share = (max_pixels / (width * height)) ** 0.5
    columns, rows = (min(max(int(length * share) // GRID * GRID, GRID), length) for length in (width, height))
    left, top = int(width * u - columns / 2), int(height * v - rows / 2)
    return Crop(min(max(left, 0), width - columns), min(max(top, 0), height - rows), columns, rows, mirrored)


class ScalePlan(NamedTuple):
    """Scale and weight at which an image is compensated."""

    zoom: float  # Factor on the focal length and sides of the image at which the head runs; 1 for the image itself
    weight: float  # Share of the correction that is added; 0 means that the head need not run


def plan(focal: float, trained: tuple[float, float] | None, pixels: int) -> ScalePlan:
    """Plan the compensation of an image of ``pixels`` and a focal length, by the shortest and longest of training."""
    if trained is None:
        return ScalePlan(1.0, 1.0)
    zoom = min(max(focal, trained[0]), trained[1]) / focal  # to the nearest one
    if 1 / TOLERANCE <= zoom <= TOLERANCE:
        return ScalePlan(1.0, 1.0)
    limit = max(MAX_PIXELS, MARGIN**2 * pixels)
    return ScalePlan(zoom, min(_fading(zoom, *FADE), _fading(pixels * zoom**2, 2 * limit, limit)))


def _fading(value: float, off: float, full: float) -> float:
    """1 up to ``full``, then linearly down to 0 at ``off``."""
    return min(max((off - value) / (off - full), 0.0), 1.0)


def resize(image: Tensor, height: int, width: int) -> Tensor:
    """Resize ``[h, w, C]`` to ``[height, width, C]``, antialiased where it shrinks."""
    resized = F.interpolate(image.permute(2, 0, 1)[None], (height, width), mode="bilinear", antialias=True)
    return resized[0].permute(1, 2, 0)


def bytes_of_module(module: nn.Module | None) -> int:
    """Bytes of a module's parameters and buffers, each in its own dtype; a shared tensor counts once; 0 for None."""
    tensors = [] if module is None else [*module.parameters(), *module.buffers()]
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


def stored_bytes(params: Mapping[str, Tensor], head: HeadConfig | None) -> int:
    """Bytes of Gaussians and their head, whose weights are not allocated; the one count that decides in training."""
    with torch.device("meta"):
        return bytes_of(params) + bytes_of_module(None if head is None else CompensationHead(head))
