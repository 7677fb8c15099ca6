"""In how many bits a packed scene stores each attribute."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from sundae_ns.errors import ConfigError

HeadFormat = Literal["int8", "fp16"]
HarmonicsCodec = Literal["transform", "codebooks"]


@dataclass
class PackConfig:
    """In how many bits each attribute is stored."""

    position_bits: int = 16
    """Bits of each coordinate within a block, 4 to 21."""
    block: int = 1024
    """Primitives of a block of positions: smaller ones are more exact and take more bytes."""
    scale_bits: int = 8
    """Bits of each log-scale, 4 to 16."""
    rotation_bits: int = 8
    """Bits of each of the three components that are stored of a rotation, 4 to 16."""
    color_bits: int = 8
    """Bits of each channel of the view-independent colour, 4 to 16."""
    opacity_bits: int = 8
    """Bits of the logit of the opacity, 4 to 16."""
    harmonics: HarmonicsCodec = "transform"
    """How the view-dependent colour is stored: transformed and rounded, or by residual codebooks, which take fewer bytes
    and lose more."""
    harmonics_step: float = 0.02
    """Step that transformed coefficients are rounded to, in units of the spherical harmonics' coefficients."""
    harmonics_books: int = 4
    """Residual codebooks of the view-dependent colour: bytes a primitive, 1 to 32."""
    feature_bits: int = 7
    """Bits of each feature, 4 to 16; the residual codebooks of feature-books replace them."""
    feature_books: int = 0
    """Residual codebooks of the feature vectors, up to 32; 0: each feature by itself, with feature-bits."""
    head: HeadFormat = "int8"
    """Weights of the head: int8 with a step for each output channel, or fp16."""
    head_bits: int = 7
    """Bits of each weight of an int8 head, 3 to 8: fewer are stored in fewer bytes."""
    level: int = 19
    """Effort of the entropy coder (zstandard), 1 to 22; unpacking is as fast at all of them."""

    def validate(self) -> None:
        """Check every option.

        Raises:
            ConfigError: the first option that cannot work, and what it may be.
        """
        bits = ("scale_bits", "rotation_bits", "color_bits", "opacity_bits", "feature_bits")
        ranges = {name: (4, 16) for name in bits} | {
            "position_bits": (4, 21),
            "block": (16, 1 << 20),
            "harmonics_books": (1, 32),
            "feature_books": (0, 32),
            "head_bits": (3, 8),
            "level": (1, 22),
        }
        for name, (least, most) in ranges.items():
            value = getattr(self, name)
            if not least <= value <= most:
                raise ConfigError(f"{name.replace('_', '-')} is {value}; give {least} to {most}")
        if not 1e-4 <= self.harmonics_step <= 1:
            raise ConfigError(f"harmonics-step is {self.harmonics_step}; give 0.0001 to 1")
        for name, choices in (("head", HeadFormat), ("harmonics", HarmonicsCodec)):
            if getattr(self, name) not in get_args(choices):
                raise ConfigError(f"{name} is {getattr(self, name)!r}; give one of {', '.join(get_args(choices))}")


FINETUNED: dict[str, int | float] = {"harmonics_step": 0.03, "feature_bits": 6, "head_bits": 6}
"""Coarser options, for scenes that have learnt to live with them (``sundae_ns.scenes.finetune``)."""
