"""Start of several ranks: options that they cannot use yet are refused, and processes on a CPU are launched."""

from __future__ import annotations

import tempfile
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch.multiprocessing.spawn import ProcessExitedException, ProcessRaisedException

from sundae_ns.errors import ConfigError, rank_ended

TIMEOUT = timedelta(minutes=30)
"""Timeout of a collective. It is long, because others wait while rank 0 prunes and saves; a dead rank is noticed anyway."""


def check_options(config: Any) -> None:
    """Refuse options that several ranks cannot use yet.

    Args:
        config: ``SundaeTrainerConfig``.

    Raises:
        ConfigError: the first option that does not fit.
    """
    model = config.pipeline.model
    pruning = model.pruning
    counted = pruning.max_primitives is not None or pruning.target_primitives is not None
    refused = {
        "--pipeline.model.warmup mcmc": model.warmup == "mcmc",
        "--pipeline.model.pruning.mode auto": pruning.mode == "auto",
        "continuous pruning to a count or under a cap": pruning.mode == "continuous" and counted,
        "a camera optimizer": model.camera_optimizer.mode != "off",
        "--mixed-precision": config.mixed_precision or config.use_grad_scaler,
        "--gradient-accumulation-steps": bool(config.gradient_accumulation_steps),
    }
    for name, given in refused.items():
        if given:
            raise ConfigError(f"{name} does not work on several GPUs yet; leave it out, or use --machine.num-devices 1")


def check_machine(ranks: int, device_type: str) -> None:
    """Refuse more ranks than ``ns-train`` can start on this machine.

    Raises:
        ConfigError: the device type is not CUDA, or there are fewer GPUs than ranks.
    """
    if device_type != "cuda":
        raise ConfigError(
            f"--machine.num-devices {ranks} needs GPUs, and --machine.device-type is {device_type}; "
            "give --machine.num-devices 1"
        )
    found = torch.cuda.device_count()
    if ranks > found:
        raise ConfigError(
            f"--machine.num-devices is {ranks} and there are {found} GPUs; give --machine.num-devices {max(found, 1)}"
        )


def without_viewer(vis: str) -> str:
    """The loggers without the viewer, which could show the primitives of one rank only."""
    return "tensorboard" if vis in ("viewer", "viewer_legacy") else vis.removeprefix("viewer+")


def launch(config: Any, ranks: int) -> None:
    """Train on several processes of this machine's CPU over gloo; on GPUs ``ns-train`` starts the ranks.

    Args:
        config: ``SundaeTrainerConfig`` for a CPU.
        ranks: number of processes.

    Raises:
        RankError: a rank ended early; all ranks are ended then.
    """
    with tempfile.TemporaryDirectory() as folder:
        context = torch.multiprocessing.spawn(
            _train, (ranks, Path(folder) / "meeting", config), nprocs=ranks, join=False
        )
        try:
            while not context.join():
                pass
        except (ProcessExitedException, ProcessRaisedException) as error:
            raise rank_ended(error) from error


def _train(rank: int, ranks: int, meeting: Path, config: Any) -> None:
    dist.init_process_group("gloo", init_method=f"file://{meeting}", rank=rank, world_size=ranks, timeout=TIMEOUT)
    torch.manual_seed(config.machine.seed + rank)
    trainer = config.setup(local_rank=rank, world_size=ranks)
    trainer.setup()
    trainer.train()
    dist.destroy_process_group()
