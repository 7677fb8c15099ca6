"""Neural compensation: a U-Net that corrects rendered images for what pruning removed."""

from sundae_ns.compensation.head import PHASES, CompensationHead, HeadConfig
from sundae_ns.compensation.phases import over_phases
from sundae_ns.compensation.scale import ScalePlan, plan, resize
from sundae_ns.compensation.unet import UNet
from sundae_ns.compensation.window import Window, training_window

__all__ = [
    "PHASES",
    "CompensationHead",
    "HeadConfig",
    "ScalePlan",
    "UNet",
    "Window",
    "over_phases",
    "plan",
    "resize",
    "training_window",
]
