"""A runner of bench jobs that trains nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from harness.plan import Job, done_file
from sundae_ns.errors import SundaeError
from sundae_ns.evaluation import HEAD_OFF, HEAD_ON, Configuration, Measured, ViewQuality

PSNR = {"sundae-warm-up": 24.0, "sundae": 27.0, "band": 25.0, "splatfacto": 28.0}


class Runner:
    """Finishes jobs without training, and can stop as a signal would."""

    def __init__(self, *, stop_after: int | None = None, broken: str = "") -> None:
        self.ran: list[str] = []
        self.stop_after, self.broken = stop_after, broken

    def __call__(self, job: Job, out: Path, on_percent: Callable[[float], object]) -> None:
        if self.stop_after is not None and len(self.ran) >= self.stop_after:
            raise KeyboardInterrupt
        if self.broken and self.broken in job.key:
            raise SundaeError("it broke")
        self.ran.append(job.key)
        on_percent(50)
        path = done_file(out, job.key)
        path.parent.mkdir(parents=True, exist_ok=True)
        small = job.method != "splatfacto" and job.kind != "warm-up"
        packed = {"bytes": 50_000, "psnr": 24.9, "ssim": 0.75, "psnr_base": 24.9, "ssim_base": 0.75} if small else None
        result = {"job": asdict(job), "measured": measured(job).as_json(), "packed": packed, "alone": True}
        path.write_text(json.dumps(result) + "\n")


def measured(job: Job) -> Measured:
    psnr = PSNR.get(job.arm.removesuffix("-no-head"), 25.5) + 0.1 * (job.seed - 42)
    ways = [Configuration(HEAD_OFF, 2.0, 1_000_000, (ViewQuality(psnr - 1, 0.8, 0.2),))]
    if job.kind == "branch" and not job.arm.endswith("-no-head"):
        ways.insert(0, Configuration(HEAD_ON, 3.5, 3_000_000, (ViewQuality(psnr, 0.9, 0.1),)))
    return Measured(
        label=job.key,
        source="runs/a",
        scene=job.scene,
        method=job.method,
        variant=job.arm,
        keep_ratio=job.keep_ratio,
        seed=job.seed,
        steps=job.steps,
        primitives=1000,
        bytes_primitives=1_000_000,
        bytes_head=0,
        resolution="100x80",
        configurations=tuple(ways),
        train_s=10.0,
        peak_primitives=1500,
    )
