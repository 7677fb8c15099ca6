"""Neural compensation: the U-Net that makes up, in image space, for what pruning lost. Floor 1."""

from sundae_ns.compensation.head import CompensationHead, HeadConfig
from sundae_ns.compensation.unet import UNet

__all__ = ["CompensationHead", "HeadConfig", "UNet"]
