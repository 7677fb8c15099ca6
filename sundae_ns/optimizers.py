"""Adam in one kernel a parameter, where there is CUDA."""

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

    def setup(self, params: Any) -> torch.optim.Optimizer:
        """The optimizer of one group of parameters."""
        params = list(params)
        fused = all(value.is_cuda for value in params)
        return torch.optim.Adam(params, lr=self.lr, eps=self.eps, weight_decay=self.weight_decay, fused=fused)
