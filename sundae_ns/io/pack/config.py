"""Options of packing: precision of each attribute."""

from __future__ import annotations

from dataclasses import dataclass, replace

from sundae_ns.core.errors import ConfigError


@dataclass
class PackConfig:
    """Precision of each attribute."""

    position_bits: int = 13  # Bits of each coordinate within a block, 4 to 16
    block: int = 1024  # Gaussians per block of positions; smaller blocks are more exact and take more bytes
    scale_step: float = 0.05  # Step of log-scales
    rotation_step: float = 0.008  # Step of the components x, y and z of unit quaternions
    color_step: float = 0.03  # Step of the view-independent colour, in units of the SH coefficients
    opacity_step: float = 0.2  # Step of the logit of the opacity
    harmonics_step: float = 0.02  # Step of the view-dependent colour, in units of the SH coefficients
    feature_step: float = 0.09  # Step of features
    head_step: float = 0.02  # Step of the head's weights, in units of the largest weight of their output channel

    def validate(self) -> None:
        """Raise ``ConfigError`` for the first invalid option, with its valid values."""
        limits = {"position_bits": (4, 16), "block": (16, 1 << 20), **dict.fromkeys(STEPS, (0.0001, 1))}
        for name, (minimum, maximum) in limits.items():
            value = getattr(self, name)
            if not minimum <= value <= maximum:
                raise ConfigError(f"{name.replace('_', '-')} is {value}; give {minimum} to {maximum}")


STEPS = ("scale_step", "rotation_step", "color_step", "opacity_step", "harmonics_step", "feature_step", "head_step")
FINEST, COARSEST = -3.0, 4.0  # powers of two of the factor by which a search for a size changes all steps


def scaled(config: PackConfig, power: float, *, with_positions: bool = True) -> PackConfig:
    """Options with all steps larger by 2^power, and as many fewer bits of positions, but at least 10."""
    steps = {name: min(max(getattr(config, name) * 2**power, 1e-4), 1.0) for name in STEPS}
    if with_positions:
        steps["position_bits"] = min(max(round(config.position_bits - power), 10), 16)
    return replace(config, **steps)  # type: ignore[arg-type]


FINETUNED = PackConfig(12, 1024, 0.1, 0.018, 0.07, 0.4, 0.06, 0.2, 0.14)  # of fine-tunes (``plugin.tuned_packs``)
FINETUNE_STEPS = 1500  # that make up for them: packs lose at most about 0.1 dB more (``curve.csv``)
LEAST_LENGTHS = 20  # of a run, in fine-tunes, whose last steps are one: measured with a twentieth
FINETUNED_SIZE = 0.6  # bytes of such a pack as a share of one without: 0.58 to 0.61 on six captures


def tuned_steps(length: int, steps: int = FINETUNE_STEPS) -> int:
    """Number of last steps of a schedule that a fine-tune takes the place of; 0 for shorter ones, which it follows."""
    return steps if length >= LEAST_LENGTHS * steps else 0
