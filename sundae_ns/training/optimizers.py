"""Adam in one kernel a parameter, where there is CUDA, and as networks without normalisation bear it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """nerfstudio's Adam; parameters on CUDA are updated by one fused kernel instead of a dozen.

    A field has an optimizer for each of its seven parameters, so launching their kernels takes a good part of a step.
    """

    betas: tuple[float, float] = (0.9, 0.999)
    """Decay of the means of gradients and of their squares, a step."""

    def setup(self, params: Any) -> torch.optim.Optimizer:
        """The optimizer of one group of parameters."""
        params = list(params)
        options = {name: getattr(self, name) for name in ("eps", "betas", "weight_decay")}
        return torch.optim.Adam(self._groups(params), fused=all(value.is_cuda for value in params), **options)

    def _groups(self, params: list[torch.Tensor]) -> list[dict[str, Any]]:
        """Parameters by their learning rate."""
        return [{"params": params, "lr": self.lr}]


@dataclass
class NetworkAdamConfig(FusedAdamConfig):
    """Adam for a network without normalisation layers, which bursts at a rate that others bear.

    Its output is a product of its layers, so that steps of all weights in the direction that they agree upon can multiply it.
    Two things keep such steps short. The mean of squares forgets so fast that it follows gradients that suddenly grow: with the
    usual betas a weight moves by 3.2 times the rate at the first long gradient after short ones, and by up to 7.3 while they
    grow; with these by 0.4 and by up to 1.2 (``sundae_ns.distributed.ahead.longest_step``). And weights of layers with many
    inputs move by less, since what they add up to grows with the inputs (Yang et al. 2022, "Tensor Programs V").

    Rates are those of the shapes at setup: a head that a search makes smaller keeps those of the larger one.
    """

    betas: tuple[float, float] = (0.9, 0.95)
    """Decay of the means of gradients and of their squares, a step."""
    full_rate_inputs: int = 1152
    """Weights that sum up more inputs than this have a smaller rate, in proportion. 1152 is 3 x 3 of 128 channels, the most in
    the default head, for which the rate is known."""

    def _groups(self, params: list[torch.Tensor]) -> list[dict[str, Any]]:
        by_rate: dict[float, list[torch.Tensor]] = {}
        for value in params:
            inputs = value[0].numel() if value.ndim > 1 else 1
            by_rate.setdefault(self.lr * min(self.full_rate_inputs / inputs, 1.0), []).append(value)
        return [{"params": values, "lr": rate} for rate, values in by_rate.items()]
