"""Options and machines that several ranks cannot use yet are refused before they start."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
from types import FrameType
from typing import Any

import torch

from sundae_ns.errors import NOTHING_SAVED, ConfigError, passed_on


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


def forward_signals() -> None:
    """Pass SIGINT and SIGTERM on to the ranks, which save and leave together, and wait for them."""

    def forward(number: int, frame: FrameType | None) -> None:
        ranks = multiprocessing.active_children()
        if not ranks:
            print(f"\n{NOTHING_SAVED}", file=sys.stderr)
            raise SystemExit(128 + number)
        passed_on.append(number)
        for process in ranks:
            with contextlib.suppress(OSError):
                # A terminal has sent SIGINT to all of them, and the second would make a rank leave at once.
                os.kill(process.pid or 0, signal.SIGTERM)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, forward)
