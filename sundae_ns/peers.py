"""Peers that nerfstudio 1.1.5 has no method for, trained by the same code on the same pictures.

The module path and the class names are written into ``config.yml`` of their runs: moving them breaks saved runs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from gsplat.strategy import MCMCStrategy
from torch import Tensor

from sundae_ns.errors import BackendError, ConfigError
from sundae_ns.model import SundaeModel, SundaeModelConfig

INITIAL_OPACITY = 0.5
INITIAL_SHRINKING = 0.1
"""Factor on the width of the first primitives."""


@dataclass
class McmcModelConfig(SundaeModelConfig):
    """A field of a fixed budget without pruning: "3D Gaussian Splatting as Markov Chain Monte Carlo" (Kheradmand 2024)."""

    _target: type = field(default_factory=lambda: McmcModel)
    cap: int = 1_000_000
    """Most primitives."""
    opacity_weight: float = 0.01
    """Weight of the mean opacity in the loss, lambda_o of that paper."""
    scale_weight: float = 0.01
    """Weight of the mean scale in the loss, lambda_Sigma of that paper."""
    noise_rate: float = 5e5
    """Factor on the exploration noise, lambda_noise of that paper."""


class McmcModel(SundaeModel):
    """gsplat's ``MCMCStrategy`` in place of densification; the rest is as without pruning and without a head.

    Args:
        config, and the rest: as for :class:`sundae_ns.model.SundaeModel`.

    Raises:
        ConfigError: pruning or a head was asked for too, or the cap is not positive.
    """

    config: McmcModelConfig

    def populate_modules(self) -> None:
        """Build the field, at most as large as the cap."""
        config = self.config
        if config.pruning.mode != "off" or config.head.mode != "off":
            raise ConfigError("this peer has no pruning and no head: set pruning.mode and head.mode to off")
        if config.cap < 1:
            raise ConfigError(f"cap is {config.cap}; give at least 1 primitive")
        super().populate_modules()
        self.strategy = MCMCStrategy(  # type: ignore[assignment]
            cap_max=config.cap,
            noise_lr=config.noise_rate,
            refine_start_iter=config.warmup_length,
            refine_stop_iter=config.stop_split_at,
            refine_every=config.refine_every,
        )
        # Not in the strategy's state of checkpoints, whose tensors have a row a primitive.
        self._binomials: dict[str, Any] = self.strategy.initialize_state()  # type: ignore[call-arg]

    def _initial_field(self) -> dict[str, Tensor]:
        params = super()._initial_field()
        n = len(params["means"])
        if n > self.config.cap:
            chosen = torch.randperm(n)[: self.config.cap]
            params = {name: value[chosen] for name, value in params.items()}
        params["opacities"] = torch.full_like(params["opacities"], math.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY)))
        params["scales"] = params["scales"] + math.log(INITIAL_SHRINKING)
        return params

    def get_training_callbacks(self, training_callback_attributes: Any) -> list[Any]:
        """As without this strategy.

        Raises:
            BackendError: there is no CUDA device; gsplat's relocation and noise have no other implementation.
        """
        if self.backend.name != "gsplat":
            raise BackendError(
                "gsplat's MCMC strategy needs a CUDA device and gsplat's kernels; leave this peer out here"
            )
        return super().get_training_callbacks(training_callback_attributes)

    def step_post_backward(self, step: int) -> None:
        """Relocate, add, and move by noise."""
        rate = self.optimizers["means"].param_groups[0]["lr"]
        self.strategy.step_post_backward(  # type: ignore[call-arg]
            params=self.gauss_params,
            optimizers=self.optimizers,
            state=self._binomials,
            step=step,
            info=self.info,
            lr=rate,
        )

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: dict[str, Any] | None = None
    ) -> dict[str, Tensor]:
        """The picture's loss and, in training, the two terms that keep primitives few and small."""
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        if self.training:
            losses["opacity_loss"] = self.config.opacity_weight * self.gauss_params["opacities"].sigmoid().mean()
            losses["scale_loss"] = self.config.scale_weight * self.gauss_params["scales"].exp().mean()
        return losses
