"""The compensation head: from splatted colours, features and accumulation to the final picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from sundae_ns.compensation.graphed import GraphedInference, GraphedTraining
from sundae_ns.compensation.unet import UNet
from sundae_ns.errors import ConfigError

SIZES: dict[str, tuple[int, int | None]] = {
    "tiny": (8, None),
    "compact": (32, 64),
    "small": (32, None),
    "regular": (64, None),
    "large": (128, None),
}
"""Channels of the finest level, and the most that a coarser one may have. The last three are the paper's."""

PRECISIONS = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}


@dataclass
class HeadConfig:
    """What the compensation head is."""

    mode: Literal["residual", "features", "off"] = "residual"
    """residual: the head adds a correction to the spherical-harmonics picture, which stays valid by itself.
    features: the paper's way, the head alone makes the picture from splatted features. off: no head."""
    size: Literal["tiny", "compact", "small", "regular", "large"] = "compact"
    """Width of the U-Net: 0.5, 2, 7.8, 31 or 124 MB in fp32. The last three are the paper's, which takes regular;
    compact is small with at most 64 channels a level."""
    pixel_unshuffle: int = 2
    """Fold blocks of this many pixels a side into channels before the U-Net: 1 is the paper's, 2 is faster."""
    num_features: int = 13
    """Length F of the feature vector of each primitive. 1, 5, 13 and 29 splat without padding."""
    start_at: int | None = None
    """Training step at which the head starts; by default it starts with the prune."""
    max_train_pixels: int = 2**20
    """Train on a random window of at most this many pixels where pictures are larger, once the head takes part; 0 for
    whole pictures."""
    precision: Literal["fp32", "bf16", "fp16"] = "bf16"
    """Arithmetic of the U-Net on CUDA; a CPU always takes fp32. fp16 is meant for inference: it trains unscaled."""
    cuda_graph: bool = True
    """Replay the U-Net as one CUDA graph while training: the same numbers, without the time of launching each kernel."""
    cuda_graph_inference: bool = False
    """The same for pictures that are only looked at, once a size is shown for the third time in a row. Not measured yet."""

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
        self._graphed = GraphedTraining(self.net, PRECISIONS[config.precision])
        self._replayed = GraphedInference(self.net)

    def forward(self, base: Tensor, colors: Tensor, features: Tensor, alpha: Tensor) -> Tensor:
        """Compensate one picture.

        Args:
            base: ``[H, W, 3]`` spherical-harmonics picture over its background, in [0, 1].
            colors: ``[H, W, 3]`` the same without background, so that the head does not depend on it.
            features: ``[H, W, F]`` splatted features.
            alpha: ``[H, W, 1]`` accumulation.

        Returns:
            ``[H, W, 3]`` float32, not clamped. Where nothing was splatted the residual head returns ``base``.
        """
        residual = self.config.mode == "residual"
        image = torch.cat([colors, alpha, features], dim=-1) if residual else features
        # [H, W, C] is the channels-last layout of [1, C, H, W]: no copy.
        out = self._run(image.permute(2, 0, 1)[None])[0].permute(1, 2, 0)
        if out.dtype == torch.float16:
            # Activations beyond its 65504 are infinite, and NaN in the next layer: no correction there.
            out = out.nan_to_num(0.0, 0.0, 0.0)
        return base + alpha * out.float() if residual else out.float()

    def _run(self, image: Tensor) -> Tensor:
        dtype = PRECISIONS[self.config.precision] if image.is_cuda else torch.float32
        out = None
        if image.is_cuda and not torch.is_grad_enabled() and self.config.cuda_graph_inference:
            out = self._replayed(image, dtype)
            # In fp32 the caller's float() would hand out the graph's own memory, which the next picture overwrites.
            out = out.clone() if out is not None and dtype == torch.float32 else out
        elif self.config.cuda_graph and image.is_cuda and image.requires_grad and self.training:
            out = self._graphed(image.to(dtype))
        if out is not None:
            return out
        with torch.autocast(image.device.type, dtype=dtype, enabled=dtype != torch.float32):
            return self.net(image.to(dtype))
