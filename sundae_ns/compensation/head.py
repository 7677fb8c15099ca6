"""The compensation head: from splatted colours, features and accumulation to the final image."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from sundae_ns.compensation.fused import FusedInference
from sundae_ns.compensation.fused_training import FusedTraining
from sundae_ns.compensation.unet import UNet
from sundae_ns.errors import BackendError, ConfigError

SIZES: dict[str, tuple[int, int | None]] = {
    "tiny": (8, None),
    "compact": (32, 64),
    "wide": (64, 64),
    "small": (32, None),
    "regular": (64, None),
    "large": (128, None),
}
"""Channels of the finest level, and the maximum of the coarser ones. The last three are the paper's."""


class Phase(NamedTuple):
    """How one of several runs of the head sees the image."""

    rows: int
    """Shift down, in halves of the head's fold."""
    columns: int
    """Shift to the right, in the same unit."""
    mirrored: bool = False
    """Whether left and right change places, for heads that train on mirrored images."""


PHASES: dict[int, tuple[Phase, ...]] = {
    1: (Phase(0, 0),),
    2: (Phase(0, 0), Phase(1, 1)),
    4: (Phase(0, 0), Phase(1, 1), Phase(0, 1, mirrored=True), Phase(1, 0, mirrored=True)),
}
"""Runs of the head for a frame, by their number."""

_log = logging.getLogger(__name__)

PRECISIONS = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}


@dataclass
class HeadConfig:
    """Architecture and arithmetic of the compensation head."""

    mode: Literal["auto", "residual", "features", "off"] = "auto"
    """auto: residual, if held-out training views show after a short trial that it pays, else off. residual: the head
    adds a correction to the spherical-harmonics image, which remains usable alone. features: the paper's, the head
    alone makes the image from splatted features, over the background. off: no head."""
    size: Literal["tiny", "compact", "wide", "small", "regular", "large"] = "wide"
    """Width of the U-Net: 0.5, 2, 2.5, 7.8, 31 or 124 MB in fp32. The last three are the paper's, whose default is
    regular; compact is small with at most 64 channels per level, wide has 64 on each."""
    pixel_unshuffle: int = 2
    """Fold blocks of this many pixels per side into channels before the U-Net: 1 is the paper's, 2 is faster."""
    num_features: int = 13
    """Length F of each primitive's feature vector. 1, 5, 13 and 29 splat without padding."""
    start_at: int | None = None
    """Training step after which the head is enabled; by default the last prune. If it is enabled for the last few
    thousand steps only, base colours stay those of a field without a head: less flicker and less overfitting to few
    views, but also less gain."""
    max_train_pixels: int = 2**22
    """Train on a random window of at most this many pixels if images are larger, once the head is enabled; 0 for whole
    images."""
    phases: Literal[1, 2, 4] = 1
    """Without gradients: average the head over this many shifts of its pixel grid, half of four in a mirror. More take
    proportionally longer, are a little better, and flicker less when a camera moves."""
    precision: Literal["fp32", "bf16", "fp16"] = "bf16"
    """Arithmetic of the U-Net on CUDA; a CPU always uses fp32. fp16 is for inference: its range is too small for
    training, which uses bf16 instead, or fp32 on GPUs before Ampere."""
    fused: bool = True
    """On CUDA, in bf16 and fp16: use our own kernels between the convolutions, recorded as one CUDA graph per image
    size, in training and inference. Otherwise run layer by layer."""

    @property
    def resolved(self) -> HeadConfig:
        """The configuration of the head while it is undecided: residual in place of auto."""
        return replace(self, mode="residual") if self.mode == "auto" else self

    def validate(self) -> None:
        """Check the values.

        Raises:
            ConfigError: a value is invalid.
        """
        if self.num_features < 1:
            raise ConfigError(
                f"head.num-features is {self.num_features}; set at least 1, or disable the head with head.mode off"
            )
        if self.pixel_unshuffle < 1:
            raise ConfigError(f"head.pixel-unshuffle is {self.pixel_unshuffle}; set 1, 2 or 4")
        if self.phases not in PHASES:
            raise ConfigError(f"head.phases is {self.phases}; set 1, 2 or 4")
        if self.max_train_pixels < 0:
            raise ConfigError(f"head.max-train-pixels is {self.max_train_pixels}; set 0 for whole images, or more")


class CompensationHead(nn.Module):
    """Computes the compensated image (``I_hat = Phi(F)`` of the paper, and our residual variant).

    Args:
        config: mode, size and arithmetic; mode auto makes a residual head, off is refused.

    Raises:
        ConfigError: the configuration is invalid.
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
        in_channels = config.num_features + (4 if config.mode == "residual" else 0)
        width, max_width = SIZES[config.size]
        self.net = UNet(
            in_channels,
            3,
            width,
            max_width=max_width,
            pixel_unshuffle=config.pixel_unshuffle,
            zero_init=config.mode == "residual",
        )
        self.net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._accelerate()

    def _accelerate(self) -> None:
        residual = self.config.mode == "residual"
        self._inference, self._training = FusedInference(self.net, residual), FusedTraining(self.net, residual)
        self._can_fuse = self.config.fused
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
        places = [(module, name) for module in self.net.modules() for name in module._parameters]
        for own, (module, name) in zip(parameters, places, strict=True):
            own.data, own.grad = getattr(module, name).data.to(own), None
            setattr(module, name, own)
        self.net.train(self.training)
        self._accelerate()

    def forward(self, base: Tensor, splatted: Tensor, alpha: Tensor) -> Tensor:
        """Compensate one image.

        Args:
            base: spherical-harmonics image over its background, in [0, 1] ``[H, W, 3]``.
            splatted: the same colours without background, so that the head does not depend on it, and the features
                ``[H, W, 3 + F]``.
            alpha: accumulation ``[H, W, 1]``.

        Returns:
            ``[H, W, 3]`` float32, not clamped. Where nothing was splatted, the residual head returns ``base``.
        """
        dtype = self._dtype(base.device)
        if self._can_fuse and dtype != torch.float32:
            try:
                return self._fused(base, splatted, alpha, dtype)
            except BackendError as error:
                _log.warning("the head runs layer by layer, not with the kernels for %s: %s", base.device, error)
                self._can_fuse = False
        residual = self.config.mode == "residual"
        image = torch.cat([splatted[..., :3], alpha, splatted[..., 3:]], dim=-1) if residual else splatted[..., 3:]
        # [H, W, C] is the channels-last layout of [1, C, H, W]: no copy.
        with torch.autocast(image.device.type, dtype=dtype, enabled=dtype != torch.float32):
            out = self.net(image.permute(2, 0, 1)[None].to(dtype))[0].permute(1, 2, 0)
        if out.dtype == torch.float16:
            # Activations beyond 65504 become infinite, and NaN in the next layer: do not correct such pixels.
            out = out.nan_to_num(0.0, 0.0, 0.0)
        return base + alpha * out.float() if residual else out.float()

    def _dtype(self, device: torch.device) -> torch.dtype:
        dtype = PRECISIONS[self.config.precision] if device.type == "cuda" else torch.float32
        if dtype != torch.float16 or not torch.is_grad_enabled():
            return dtype
        # Overflow leaves a pixel uncorrected, but would be NaN in the gradients of all earlier layers.
        return torch.bfloat16 if torch.cuda.get_device_capability(device) >= (8, 0) else torch.float32

    def _fused(self, base: Tensor, splatted: Tensor, alpha: Tensor, dtype: torch.dtype) -> Tensor:
        if not torch.is_grad_enabled():
            return self._inference(base, splatted, alpha, dtype)
        out = self._training(splatted, alpha, dtype)
        return base + out if self.config.mode == "residual" else out
