"""3DGS-MCMC (Kheradmand et al., 2024) as a method of ns-train: stock splatfacto with gsplat's ``MCMCStrategy``.

    export NERFSTUDIO_METHOD_CONFIGS=splatfacto-mcmc=mcmc:METHOD PYTHONPATH=benchmarks
    echo "[{name: mcmc, method: splatfacto-mcmc, options: {pipeline.model.max-gs-num: '50761'}}]" > mcmc.yaml
    python benchmarks/suite.py CAPTURES -o DIR --arms mcmc.yaml --scenes bonsai --seeds 42 43 44

Opacities, scales and the two penalties are those of gsplat's own example of the strategy.
"""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import torch
from gsplat.strategy import MCMCStrategy
from nerfstudio.configs.method_configs import method_configs
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from nerfstudio.plugins.types import MethodSpecification


class McmcModel(SplatfactoModel):
    """Splatfacto whose Gaussians are relocated and added up to a number, with noise on their centres."""

    config: McmcModelConfig

    def populate_modules(self) -> None:
        cap = self.config.max_gs_num
        if self.seed_points is not None and len(self.seed_points[0]) > cap:
            points, colors = self.seed_points
            chosen = torch.randperm(len(points))[:cap]
            self.seed_points = points[chosen], colors[chosen]
        super().populate_modules()
        with torch.no_grad():
            self.gauss_params["opacities"].zero_()
            self.gauss_params["scales"] += math.log(0.1)
        self.strategy: Any = MCMCStrategy(cap_max=cap)
        self.strategy.absgrad = False  # splatfacto asks
        self.strategy_state = self.strategy.initialize_state()

    def step_post_backward(self, step: int) -> None:
        lr = self.optimizers["means"].param_groups[0]["lr"]
        params, state = self.gauss_params, self.strategy_state
        self.strategy.step_post_backward(params, self.optimizers, state, step, self.info, lr=lr)

    def get_loss_dict(self, outputs: Any, batch: Any, metrics_dict: Any = None) -> dict[str, torch.Tensor]:
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        losses["opacity"] = 0.01 * self.opacities.sigmoid().mean()
        losses["scale"] = 0.01 * self.scales.exp().mean()
        return losses


@dataclass
class McmcModelConfig(SplatfactoModelConfig):
    """Splatfacto's options, and how many Gaussians there may be."""

    _target: type = field(default_factory=lambda: McmcModel)
    max_gs_num: int = 1_000_000


_config: Any = deepcopy(method_configs["splatfacto"])
_config.method_name, _config.pipeline.model = "splatfacto-mcmc", McmcModelConfig()
METHOD = MethodSpecification(_config, "splatfacto with gsplat's MCMCStrategy")
