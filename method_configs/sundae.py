"""Methods of SUNDAE: a configuration each, built anew by helpers so that no two share an object."""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from sundae_ns.head.head import HeadConfig
from sundae_ns.plugin import optimizer_configs as configs
from sundae_ns.plugin.datamanager import SundaeDatamanagerConfig
from sundae_ns.plugin.model import SundaeModelConfig
from sundae_ns.plugin.trainer import SundaeTrainerConfig
from sundae_ns.train.pruning import PruningConfig


def optimizers(steps: int, *, plain: bool = False) -> dict[str, Any]:
    """Optimizers for a run of ``steps``: splatfacto's rates, and rates of features and head.

    Right after the prune the rate of the centres restarts, so that kept Gaussians can fill the gaps. ``plain`` leaves
    out what is not in the paper: this restart, and weight decay of the head.
    """
    rates = {**configs.RATES, "camera_opt": 1e-4}
    rates["features_rest"] *= configs.HARMONICS_EVERY
    groups: dict[str, Any] = {
        name: {"optimizer": configs.FusedAdamConfig(lr=rate, eps=1e-15), "scheduler": None}
        for name, rate in rates.items()
    }
    restart = None if plain else rates["means"]
    groups["means"]["scheduler"] = configs.PruneAwareDecayConfig(lr_final=1.6e-6, max_steps=steps, lr_restart=restart)
    groups["camera_opt"]["scheduler"] = configs.PruneAwareDecayConfig(lr_final=5e-7, max_steps=steps)
    rise = min(500, steps // 12)
    groups["compensation"] = {
        # The usual eps: with the tiny one of 3DGS, weights with almost no gradient would take full steps.
        "optimizer": configs.NetworkAdamConfig(lr=1e-3, eps=1e-8, weight_decay=0.0 if plain else 0.15),
        "scheduler": configs.PruneAwareDecayConfig(
            lr_final=1e-5, max_steps=steps, lr_restart=1e-3, hold_until_prune=True, warmup_steps=rise, shape="cosine"
        ),
    }
    return groups


def method(
    name: str,
    description: str,
    pruning: PruningConfig,
    *,
    head: HeadConfig | None = None,
    steps: int = 30000,
    plain_optimizers: bool = False,
    trainer: dict[str, Any] | None = None,
    **model: Any,
) -> MethodSpecification:
    """One method: its name and line in ``ns-train --help``, its length, and options of trainer and model."""
    options: dict[str, Any] = {
        "steps_per_eval_batch": 0,
        "steps_per_save": 2000,
        "steps_per_eval_all_images": 5000,
        "vis": "viewer",
    }
    config = SundaeTrainerConfig(
        method_name=name,
        max_num_iterations=steps,
        mixed_precision=False,
        machine=MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu"),
        pipeline=VanillaPipelineConfig(
            datamanager=SundaeDatamanagerConfig(
                dataparser=NerfstudioDataParserConfig(load_3D_points=True),
                cache_images_type="uint8",
                robust_frame=True,
            ),
            model=SundaeModelConfig(
                pruning=pruning, head=head or HeadConfig(), camera_optimizer=CameraOptimizerConfig(mode="off"), **model
            ),
        ),
        logging=LoggingConfig(
            steps_per_log=100 if torch.cuda.is_available() else 10,  # TensorBoard waits for the GPU to read a figure
            local_writer=LocalWriterConfig(_target=configs.ProgressWriter, enable=True),
        ),
        optimizers=optimizers(steps, plain=plain_optimizers),
        # A training ends by itself, so that the next command runs; ns-viewer shows the run afterwards.
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15, quit_on_train_completion=True),
        **options | (trainer or {}),
    )
    return MethodSpecification(config=config, description=description)


def _keep(percent: int) -> MethodSpecification:
    line = f"SUNDAE that keeps {percent}% of the Gaussians, with a head where it pays."
    return method(f"sundae-{percent}", line, PruningConfig(keep_ratio=percent / 100))


# The paper's ratios; --pipeline.model.pruning.keep-ratio takes any other.
sundae_1, sundae_30, sundae_50, sundae_80, sundae_100 = map(_keep, (1, 30, 50, 80, 100))

sundae = method(
    "sundae",
    "SUNDAE: graph-merged Gaussians with neural compensation, as small as held-out training views allow.",
    PruningConfig(keep_ratio=None),
)

sundae_continuous = method(
    "sundae-continuous",
    "SUNDAE with continuous pruning during densification: a lower peak of memory, an optional cap and final number.",
    PruningConfig(mode="continuous", keep_ratio=0.5, start=2000, stop=15000, every=2000),
    stop_split_at=15000,
)

sundae_fast = method(
    "sundae-fast",
    "SUNDAE in the shortest time: 18,000 steps, pruned after a third of them.",
    PruningConfig(keep_ratio=0.1, prune_at=6000),
    steps=18000,
    warmup_length=300,
    refine_every=60,
    reset_alpha_every=25,
    stop_split_at=6000,
    stop_screen_size_at=2400,
    resolution_schedule=1800,
    sh_degree_interval=600,
)

sundae_paper = method(
    "sundae-paper",
    "SUNDAE as the paper's text has it: band rule on positions, feature splatting, 30 MB U-Net, 60,000 steps.",
    PruningConfig(
        keep_ratio=0.1,
        prune_at=15000,
        selection="band",
        score="response",
        signal="positions",
        edges="centres",
        redistribution="none",
        gamma=0.5,
    ),
    head=HeadConfig(
        mode="features", size="regular", pixel_unshuffle=1, num_features=13, precision="fp32", max_train_pixels=0
    ),
    steps=60000,
    plain_optimizers=True,
    stop_split_at=15000,
    base_loss_weight=0.0,
    average_share=0.0,
    drop_rate=0.0,
    loss_after_prune="l1",
    prior_after_prune=0.0,
    exposure_compensation="off",
    dense_start_views=0,
    ssim_lambda=0.25,
)

sundae_tiny = method(
    "sundae-tiny",
    "SUNDAE for a first look: small scenes, a few minutes on a CPU.",
    PruningConfig(keep_ratio=0.25, prune_at=600),
    head=HeadConfig(mode="residual", size="tiny", pixel_unshuffle=1, num_features=5),
    steps=1200,
    trainer={"vis": "tensorboard", "steps_per_save": 400, "steps_per_eval_all_images": 10000},
    num_downscales=0,
    sh_degree=2,
    sh_degree_interval=200,
    warmup_length=100,
    stop_split_at=600,
    stop_screen_size_at=0,
    reset_alpha_every=100,
    densify_grad_thresh=0.0016,
    cull_alpha_thresh=0.02,
    drop_rate=0.0,  # of so few Gaussians each is missed
    dense_start_views=0,
)
