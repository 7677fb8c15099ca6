"""The compensation head: from splatted colours, features and accumulation to the final picture."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Literal

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
"""Channels of the finest level, and the most that a coarser one may have. The last three are the paper's."""

PHASES: dict[int, tuple[tuple[int, int], ...]] = {
    1: ((0, 0),),
    2: ((0, 0), (1, 1)),
    4: ((0, 0), (1, 1), (0, 1), (1, 0)),
}
"""Rows and columns that a picture is moved by, in halves of the head's fold, by how often the head runs."""

_log = logging.getLogger(__name__)

PRECISIONS = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}


@dataclass
class HeadConfig:
    """What the compensation head is."""

    mode: Literal["residual", "features", "off"] = "residual"
    """residual: the head adds a correction to the spherical-harmonics picture, which stays valid by itself.
    features: the paper's way, the head alone makes the picture from splatted features, over the background. off: no head."""
    size: Literal["tiny", "compact", "wide", "small", "regular", "large"] = "wide"
    """Width of the U-Net: 0.5, 2, 2.5, 7.8, 31 or 124 MB in fp32. The last three are the paper's, which takes regular;
    compact is small with at most 64 channels a level, wide has 64 on each."""
    pixel_unshuffle: int = 2
    """Fold blocks of this many pixels a side into channels before the U-Net: 1 is the paper's, 2 is faster."""
    num_features: int = 13
    """Length F of the feature vector of each primitive. 1, 5, 13 and 29 splat without padding."""
    start_at: int | None = None
    """Training step after which the head takes part; by default the prune, or the last of them. Some thousand steps before the
    end, base colours stay those of a field without a head, and what flickers and what overfits few views is less; where a head
    gains much, it gains less."""
    max_train_pixels: int = 2**22
    """Train on a random window of at most this many pixels where pictures are larger, once the head takes part; 0 for
    whole pictures."""
    phases: Literal[1, 2, 4] = 1
    """Pictures that are only looked at: mean over so many places of the head's grid of pixels. More take as many times the
    head's time, and flicker less as a camera moves."""
    precision: Literal["fp32", "bf16", "fp16"] = "bf16"
    """Arithmetic of the U-Net on CUDA; a CPU always takes fp32. fp16 is for pictures that are only looked at: its range is too
    small to train in, which fp16 does in bf16, or in fp32 on GPUs before Ampere."""
    fused: bool = True
    """On CUDA, in bf16 and fp16: run through our own kernels between the convolutions, and as one CUDA graph for each picture
    size, both while training and for pictures that are only looked at. Otherwise layer by layer."""

    def validate(self) -> None:
        """Check the values.

        Raises:
            ConfigError: a value cannot work.
        """
        if self.num_features < 1:
            raise ConfigError(
                f"head.num-features is {self.num_features}; give at least 1, or switch the head off with head.mode off"
            )
        if self.pixel_unshuffle < 1:
            raise ConfigError(f"head.pixel-unshuffle is {self.pixel_unshuffle}; give 1, 2 or 4")
        if self.phases not in PHASES:
            raise ConfigError(f"head.phases is {self.phases}; give 1, 2 or 4")
        if self.max_train_pixels < 0:
            raise ConfigError(f"head.max-train-pixels is {self.max_train_pixels}; give 0 for whole pictures, or more")


class CompensationHead(nn.Module):
    """Makes the compensated picture (``I_hat = Phi(F)`` of the paper, and a residual variant of ours).

    Args:
        config: mode, size and arithmetic; ``mode="off"`` has no head to build.

    Raises:
        ConfigError: the configuration cannot work.
    """

    def __init__(self, config: HeadConfig) -> None:
        super().__init__()
        self._build(config)

    def _build(self, config: HeadConfig) -> None:
        config.validate()
        if config.mode == "off":
            raise ConfigError("head.mode is off: there is no compensation head to build; ask for residual or features")
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

    def train(self, mode: bool = True) -> CompensationHead:
        """Switch between training and evaluation, which no layer of it tells apart."""
        # Trainers say so at each step; the layers need not be told one by one what they know.
        return self if self.training == mode else super().train(mode)

    @torch.no_grad()
    def resize(self, config: HeadConfig) -> None:
        """Become the head of another size or feature width, with fresh weights.

        The parameters stay the same objects, which an optimizer may hold; a state that it has of them is stale.
        """
        held = list(self.parameters())
        self._build(config)
        places = [(module, name) for module in self.net.modules() for name in module._parameters]
        for own, (module, name) in zip(held, places, strict=True):
            own.data, own.grad = getattr(module, name).data.to(own), None
            setattr(module, name, own)
        self.net.train(self.training)
        self._accelerate()

    def forward(self, base: Tensor, splatted: Tensor, alpha: Tensor) -> Tensor:
        """Compensate one picture.

        Args:
            base: ``[H, W, 3]`` spherical-harmonics picture over its background, in [0, 1].
            splatted: ``[H, W, 3 + F]`` the same colours without background, so that the head does not depend on it, and the
                features.
            alpha: ``[H, W, 1]`` accumulation.

        Returns:
            ``[H, W, 3]`` float32, not clamped. Where nothing was splatted the residual head returns ``base``.
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
        out = self._layers(image.permute(2, 0, 1)[None], dtype)[0].permute(1, 2, 0)
        if out.dtype == torch.float16:
            # Activations beyond its 65504 are infinite, and NaN in the next layer: no correction there.
            out = out.nan_to_num(0.0, 0.0, 0.0)
        return base + alpha * out.float() if residual else out.float()

    def _dtype(self, device: torch.device) -> torch.dtype:
        dtype = PRECISIONS[self.config.precision] if device.type == "cuda" else torch.float32
        if dtype != torch.float16 or not torch.is_grad_enabled():
            return dtype
        # What overflows is left out of a picture, but would be NaN in the gradients of all that lies before it.
        return torch.bfloat16 if torch.cuda.get_device_capability(device) >= (8, 0) else torch.float32

    def _fused(self, base: Tensor, splatted: Tensor, alpha: Tensor, dtype: torch.dtype) -> Tensor:
        if not torch.is_grad_enabled():
            return self._inference(base, splatted, alpha, dtype)
        out = self._training(splatted, alpha, dtype)
        return base + out if self.config.mode == "residual" else out

    def _layers(self, image: Tensor, dtype: torch.dtype) -> Tensor:
        with torch.autocast(image.device.type, dtype=dtype, enabled=dtype != torch.float32):
            return self.net(image.to(dtype))
