"""Neural compensation: a U-Net that corrects rendered images for what pruning removed."""

from sundae_ns.compensation.head import (
    CompensationHead,
    HeadConfig,
    ScalePlan,
    Window,
    plan,
    resize,
    training_window,
)
from sundae_ns.compensation.unet import UNet

__all__ = [
    "CompensationHead",
    "HeadConfig",
    "ScalePlan",
    "UNet",
    "Window",
    "plan",
    "resize",
    "training_window",
]
