"""How ranks come to be: what they cannot do yet is refused, they start, and each takes its block of the field."""

from __future__ import annotations

import random
import tempfile
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import torch.distributed as dist
from torch.multiprocessing.spawn import ProcessExitedException, ProcessRaisedException

from sundae_ns.distributed.shards import Shards, bounds
from sundae_ns.errors import ConfigError, rank_ended

if TYPE_CHECKING:
    from sundae_ns.model import SundaeModel

TIMEOUT = timedelta(minutes=30)
"""Of a collective. Rank 0 prunes and saves while others wait, so it is long; the death of a rank is noticed without it."""


def check_options(config: Any) -> None:
    """Refuse what several ranks cannot do yet, before anything is trained.

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
    """Refuse more ranks than ``ns-train`` can start here.

    Raises:
        ConfigError: the ranks are not on GPUs, or there are not so many.
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
    """The same choice of loggers without the viewer, which could show one rank's primitives only."""
    return "tensorboard" if vis in ("viewer", "viewer_legacy") else vis.removeprefix("viewer+")


def take_shard(model: SundaeModel, seed: int) -> Shards:
    """Give all ranks the field and the head of rank 0, and let each keep its block of the field. Collective.

    Args:
        model: as it was made, with as many primitives on each rank.
        seed: of what all ranks have to draw alike, such as the picture to evaluate.
    """
    shards = Shards(model.device)
    head = [] if model.head is None else [*model.head.parameters(), *model.head.buffers()]
    for value in [*model.gauss_params.values(), *head]:
        dist.broadcast(value.data, 0)
    start, end = bounds(model.num_points, shards.ranks)[shards.rank : shards.rank + 2]
    for value in model.gauss_params.values():
        value.data = value.data[start:end].clone()
    shards.recount(model.gaussians)
    random.seed(seed)
    return shards


def launch(config: Any, ranks: int) -> None:
    """Train on several processes of this machine's CPU, over gloo; on GPUs ``ns-train`` starts the ranks itself.

    Args:
        config: ``SundaeTrainerConfig`` for a CPU.
        ranks: how many.

    Raises:
        RankError: a rank has ended before its time; by then all have.
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
