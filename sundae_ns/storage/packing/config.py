"""Options of packing: precision of each attribute."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from sundae_ns.errors import ConfigError

HeadFormat = Literal["int8", "fp16"]


@dataclass
class PackConfig:
    """Precision of each attribute."""

    position_bits: int = 16
    """Bits of each coordinate within a block, 4 to 21."""
    block: int = 1024
    """Primitives per block of positions; smaller blocks are more exact and take more bytes."""
    scale_bits: int = 8
    """Bits of each log-scale, 4 to 16."""
    rotation_bits: int = 8
    """Bits of each of the three stored components of a rotation, 4 to 16."""
    color_bits: int = 8
    """Bits of each channel of the view-independent colour, 4 to 16."""
    opacity_bits: int = 8
    """Bits of the logit of the opacity, 4 to 16."""
    harmonics_step: float = 0.02
    """Step of the transformed view-dependent colour, in units of the SH coefficients, 0.0001 to 1."""
    feature_bits: int = 7
    """Bits of each feature, 4 to 16."""
    head: HeadFormat = "int8"
    """Weights of the head: int8 with one step per output channel, or fp16."""
    head_bits: int = 7
    """Bits of each weight of an int8 head, 3 to 8; fewer bits compress to fewer bytes."""
    level: int = 19
    """Compression level of zstandard, 1 to 22; the speed of unpacking does not depend on it."""

    def validate(self) -> None:
        """Check every option.

        Raises:
            ConfigError: names the first invalid option and its valid values.
        """
        bits = ("scale_bits", "rotation_bits", "color_bits", "opacity_bits", "feature_bits")
        ranges = {name: (4, 16) for name in bits} | {
            "position_bits": (4, 21),
            "block": (16, 1 << 20),
            "head_bits": (3, 8),
            "level": (1, 22),
        }
        for name, (minimum, maximum) in ranges.items():
            value = getattr(self, name)
            if not minimum <= value <= maximum:
                raise ConfigError(f"{name.replace('_', '-')} is {value}; give {minimum} to {maximum}")
        if not 1e-4 <= self.harmonics_step <= 1:
            raise ConfigError(f"harmonics-step is {self.harmonics_step}; give 0.0001 to 1")
        if self.head not in get_args(HeadFormat):
            raise ConfigError(f"head is {self.head!r}; give one of {', '.join(get_args(HeadFormat))}")


FINETUNED: dict[str, int | float] = {"harmonics_step": 0.03, "feature_bits": 6, "head_bits": 6}
"""Coarser options for scenes that were fine-tuned with them (``sundae_ns.scenes.finetune``)."""
