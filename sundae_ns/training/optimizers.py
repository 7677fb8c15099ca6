"""Adam with one fused kernel for each parameter on CUDA, and Adam for a network without normalisation layers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """nerfstudio's Adam; on CUDA one fused kernel updates a parameter instead of a dozen.

    A field has seven parameters with an optimizer each, and launching their kernels takes much of a step.
    """

    betas: tuple[float, float] = (0.9, 0.999)
    """Decay rates of the running means of gradients and of their squares."""
    decoupled: bool = False
    """Whether weight decay acts beside Adam's step (Loshchilov & Hutter 2019), not through the gradient."""

    def setup(self, params: Any) -> torch.optim.Optimizer:
        """Optimizer of one group of parameters."""
        params = list(params)
        options = {name: getattr(self, name) for name in ("eps", "betas", "weight_decay")}
        fused = all(value.is_cuda for value in params)
        return torch.optim.Adam(self._groups(params), fused=fused, decoupled_weight_decay=self.decoupled, **options)

    def _groups(self, params: list[torch.Tensor]) -> list[dict[str, Any]]:
        """Parameter groups by learning rate."""
        return [{"params": params, "lr": self.lr}]


@dataclass
class NetworkAdamConfig(FusedAdamConfig):
    """Adam for a network without normalisation layers, whose loss bursts at usual settings.

    The output is a product of layers, so aligned steps of all weights multiply it. Two measures keep such steps short.
    The mean of squares forgets fast and follows gradients that suddenly grow. With the usual betas a weight moves by up
    to 7.3 times the rate while they grow, with these by up to 1.2 (``(1 - b1) / sqrt((1 - b2) (1 - b1^2 / b2))``).
    Weights of layers with many inputs get a smaller rate, because their sum grows with the inputs (Yang et al. 2022,
    "Tensor Programs V"). Weight decay shrinks weights, not biases.

    Rates follow the shapes at setup: a head that is resized in training keeps them.
    """

    betas: tuple[float, float] = (0.9, 0.95)
    """Decay rates of the running means of gradients and of their squares."""
    full_rate_inputs: int = 1152
    """Weights with more inputs than this get a proportionally smaller rate. 1152 is 3 x 3 of 128 channels, the most in
    the default head."""
    decoupled: bool = True

    def _groups(self, params: list[torch.Tensor]) -> list[dict[str, Any]]:
        groups: dict[tuple[float, float], list[torch.Tensor]] = {}
        for value in params:
            inputs = value[0].numel() if value.ndim > 1 else 1
            rate = self.lr * min(self.full_rate_inputs / inputs, 1.0)
            groups.setdefault((rate, self.weight_decay if value.ndim > 1 else 0), []).append(value)
        return [{"params": values, "lr": rate, "weight_decay": decay} for (rate, decay), values in groups.items()]
