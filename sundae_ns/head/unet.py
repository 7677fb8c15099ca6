"""The paper's network: four levels, average pooling, bilinear upsampling, skip connections, no normalisation layers.

No normalisation on purpose: the viewer switches between training and evaluation for every frame, and an image must not
depend on earlier ones.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

LEVELS = 4  # number of resolutions of the network; the coarsest is 1 / 2 ** (LEVELS - 1) of its input
SLOPE = 0.1  # slope of the activation below zero. Without normalisation a plain ReLU can die, and whole levels with it


def _double_conv(c_in: int, c_out: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for channels in (c_in, c_out):
        conv = nn.Conv2d(channels, c_out, 3, padding=1, dtype=torch.float32)
        # Keep the variance of activations through the depth (He et al. 2015): there is no normalisation.
        # For a tensor without values torch would import its compiler, which takes most of a second.
        if not conv.weight.is_meta:
            nn.init.kaiming_normal_(conv.weight, a=SLOPE)
        nn.init.zeros_(conv.bias)  # type: ignore[arg-type]
        layers += [conv, nn.LeakyReLU(SLOPE, inplace=True)]
    return nn.Sequential(*layers)


class UNet(nn.Module):
    """Four-level fully convolutional U-Net (Neural Compensation section of the paper).

    Works at any image size of at least one pixel: inputs are padded by zeros to a multiple of ``pixel_unshuffle * 2 **
    (LEVELS - 1)`` and the result is cropped back. The finest level has ``width`` channels, 64 for the paper's 30 MB;
    each coarser one doubles them, to at most ``max_width``, None for no limit. ``pixel_unshuffle`` folds blocks of this
    many pixels per side into channels first, and unfolds the result: 1 is the paper's network, 2 quarters the work at
    the full-resolution level. ``zero_init`` initialises the output to exactly zero.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        width: int,
        *,
        max_width: int | None = None,
        pixel_unshuffle: int = 1,
        zero_init: bool = False,
    ) -> None:
        super().__init__()
        most = max_width or width * 2**LEVELS
        widths = [min(width * 2**level, most) for level in range(LEVELS)]
        fold = pixel_unshuffle**2
        self.pixel_unshuffle = pixel_unshuffle
        inputs = [in_channels * fold, *widths[:-1]]
        self.encoder = nn.ModuleList(_double_conv(c_in, c_out) for c_in, c_out in zip(inputs, widths, strict=True))
        self.decoder = nn.ModuleList(
            _double_conv(coarse + fine, fine) for coarse, fine in zip(widths[:0:-1], widths[-2::-1], strict=True)
        )
        self.out = nn.Conv2d(width, out_channels * fold, 1, dtype=torch.float32)
        if zero_init:
            nn.init.zeros_(self.out.weight)
            nn.init.zeros_(self.out.bias)  # type: ignore[arg-type]

    def forward(self, image: Tensor) -> Tensor:
        """The output ``[B, out_channels, H, W]`` of an image ``[B, in_channels, H, W]``, any H and W of at least 1."""
        height, width = image.shape[-2:]
        stride = self.pixel_unshuffle * 2 ** (LEVELS - 1)
        bottom, right = -height % stride, -width % stride
        # Pad by zeros, as the convolutions do.
        x = F.pad(image, (0, right, 0, bottom)) if bottom or right else image
        x = x if self.pixel_unshuffle == 1 else F.pixel_unshuffle(x, self.pixel_unshuffle)  # by 1 they copy
        skips: list[Tensor] = []
        for level, block in enumerate(self.encoder):
            x = block(x if level == 0 else F.avg_pool2d(x, 2))
            skips.append(x)
        skips.pop()
        for block in self.decoder:
            x = F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)
            if x.requires_grad:
                x.register_hook(_dense)
            x = block(torch.cat([x, skips.pop()], dim=1))
        x = self.out(x)
        x = x if self.pixel_unshuffle == 1 else F.pixel_shuffle(x, self.pixel_unshuffle)
        return x[..., :height, :width]


def _dense(grad: Tensor | None) -> Tensor | None:
    """The gradient of some channels as a tensor of its own: upsampling by a slice takes a CPU three times as long."""
    return None if grad is None else grad.contiguous(memory_format=torch.channels_last)
