"""The options of a model that its parts depend on; ``SundaeModelConfig`` and splatfacto document them."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Protocol

from sundae_ns.compensation import HeadConfig
from sundae_ns.training.pruning_config import PruningConfig


class ModelOptions(Protocol):
    """Options of a model."""

    pruning: PruningConfig
    head: HeadConfig
    dense_start_views: int
    warm_start: Path | None
    warm_start_frame: Literal["auto", "model", "capture"]
    evaluate_prune: bool
    base_loss_weight: float
    loss_after_prune: Literal["l1", "rms"]
    prior_after_prune: float
    average_share: float
    photo_gains: Literal["auto", "on", "off"]

    # Options of splatfacto.
    sh_degree: int
    sh_degree_interval: int
    random_init: bool
    num_random: int
    random_scale: float
    ssim_lambda: float
    use_bilateral_grid: bool
    warmup_length: int
    refine_every: int
    cull_alpha_thresh: float
    densify_grad_thresh: float
    densify_size_thresh: float
    split_screen_size: float
    cull_scale_thresh: float
    cull_screen_size: float
    stop_screen_size_at: int
    stop_split_at: int
    reset_alpha_every: int
    use_absgrad: bool
