"""Heads at full resolution in place of the U-Net, layer by layer: "net": [KIND, {OPTIONS}] of full.py.

  ["thin", {"width": 32, "dilations": [1, 1, 1], "k": 3, "skip": false}]   a stack of k x k layers; k 1 is per pixel
  ["low", {"width": 32, "dilations": [1, 1], "low": 16, "unet": 48, "factor": 4}]   behind a U-Net at a quarter of the resolution
"""
import torch
import torch.nn.functional as F
from torch import nn

import sundae_ns.compensation.head as head_module
from sundae_ns.compensation.unet import SLOPE, UNet


def conv(i, o, k=3, d=1):
    c = nn.Conv2d(i, o, k, padding=d * (k // 2), dilation=d)
    nn.init.kaiming_normal_(c.weight, a=SLOPE)
    nn.init.zeros_(c.bias)
    return c


class Thin(nn.Module):
    pixel_unshuffle = 1

    def __init__(self, i, o, width=32, dilations=(1, 1, 1), k=3, skip=False):
        super().__init__()
        self.convs = nn.ModuleList(conv(i if n == 0 else width, width, k, d) for n, d in enumerate(dilations))
        self.out = nn.Conv2d(width, o, 1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)
        self.skip = skip

    def forward(self, x):
        for n, c in enumerate(self.convs):
            y = F.leaky_relu(c(x), SLOPE)
            x = x + y if self.skip and n else y
        return self.out(x)


class ThinLow(nn.Module):
    pixel_unshuffle = 1

    def __init__(self, i, o, width=32, dilations=(1, 1), low=16, unet=48, factor=4):
        super().__init__()
        self.factor = factor
        self.low = UNet(i, low, unet, max_width=unet, pixel_unshuffle=1)
        self.thin = Thin(i + low, o, width, dilations)
        self.out = self.thin.out

    def forward(self, x):
        h, w = x.shape[-2:]
        f = self.factor
        y = self.low(F.avg_pool2d(F.pad(x, (0, -w % f, 0, -h % f)), f))
        y = F.interpolate(y, scale_factor=float(f), mode="bilinear", align_corners=False)[..., :h, :w]
        return self.thin(torch.cat([x, y.to(x.dtype)], 1))


def install(kind, options):
    cls = {"thin": Thin, "low": ThinLow}[kind]
    head_module.UNet = lambda i, o, width, **_: cls(i, o, **options)
    head_module.FusedInference = head_module.FusedTraining = lambda net, residual: None
