"""Comparisons as data: arms and jobs. Nothing runs here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeAlias

from sundae_ns.core.errors import ConfigError, DataError

Kind = Literal["branch", "whole"]
"""How an arm trains: from a warm-up that others share, or by itself from scratch."""

Words: TypeAlias = tuple[str, ...]
"""Words of a command line."""
Shares: TypeAlias = Sequence[float]

WARM_UP = "warm-up"


@dataclass(frozen=True)
class Arm:
    """One side of a comparison."""

    name: str
    kind: Kind
    method: str  # of ns-train
    options: Mapping[str, Words] = field(default_factory=dict)  # of ns-train by name, without the dashes
    steps: int = 30_000  # of its own training
    warmup: int = 0  # steps of its method's warm-up; 0 for an arm that trains whole
    total: int = 0  # steps of warm-up and fine-tuning together; 0 for an arm that trains whole
    keep_ratio: float | None = None  # its own share of the warm-up's Gaussians, in place of the plan's
    at_every_ratio: bool = False  # an arm that trains whole runs at every share of the plan, because it prunes once


@dataclass(frozen=True)
class Job:
    """One training with its evaluation."""

    key: str  # name, unique in a plan; also of its folder
    kind: Literal["warm-up", "branch", "whole"]
    scene: str
    arm: str
    data: str  # folder of the capture
    method: str  # of ns-train
    steps: int
    seed: int
    keep_ratio: float | None = None  # share of the Gaussians to keep; None where there is none, or the arm decides it
    needs: str | None = None  # key of the warm-up that it starts from
    options: Words = ()  # of ns-train
    parser: Words = ()  # the data parser and its options; empty for the method's own


def parser_of(data: Path, downscale: int = 1) -> Words:
    """Words of the data parser for a capture: none for a ``transforms.json``; for COLMAP every 8th image is for test.

    If all images are named ``train_...`` or ``eval_...``, the names decide instead.
    """
    if (data / "sparse" / "0").is_dir():
        images = data / ("images" if downscale == 1 else f"images_{downscale}")
        if not images.is_dir():
            raise DataError(f"{images} does not exist; unpack all of the capture, or give another --downscale")
        named = {path.name.partition("_")[0] for path in images.iterdir()} == {"train", "eval"}
        return (
            *("colmap", "--colmap-path", "sparse/0", "--downscale-factor", str(downscale)),
            # Published smaller images are rounded to the nearest pixel.
            *("--downscale-rounding-mode", "round", "--eval-mode"),
            *(("filename",) if named else ("interval", "--eval-interval", "8")),
        )
    if (data / "transforms.json").is_file():
        if downscale != 1:
            raise ConfigError("--downscale is for captures in COLMAP layout; transforms.json names its own images")
        return ()
    if not data.is_dir():
        raise DataError(f"{data} is no folder; give the folder of a capture")
    raise DataError(f"{data} is no capture: it has neither sparse/0 nor transforms.json; make one by sundae poses")


def plan_scene(
    data: Path, parser: Words, arms: Sequence[Arm], *, keep_ratios: Shares, seeds: Sequence[int], repeat_at: Shares
) -> list[Job]:
    """All jobs on one capture, warm-ups before the jobs that need them; ``ConfigError`` for a wrong ratio or seed.

    The first seed runs everything; the others repeat the ratios of ``repeat_at``, from warm-ups of their own.
    """
    _check(keep_ratios, seeds, repeat_at, [arm.keep_ratio for arm in arms if arm.keep_ratio is not None])
    jobs: list[Job] = []
    for number, seed in enumerate(seeds):
        base = Job("", "whole", data.name, "", str(data), "", 0, seed, parser=parser)
        warmups: dict[str, Job] = {}
        branches: list[Job] = []
        wholes: list[Job] = []
        for arm in arms:
            if arm.kind == "whole" and not arm.at_every_ratio:
                wholes.append(_job(base, arm, None))
                continue
            for ratio in keep_ratios if arm.keep_ratio is None else (arm.keep_ratio,):
                if number > 0 and ratio not in repeat_at:
                    continue
                if arm.kind == "whole":
                    wholes.append(_job(base, arm, ratio))
                else:
                    warmup = warmups.setdefault(arm.method, _warmup(base, arm))
                    branches.append(replace(_job(base, arm, ratio), needs=warmup.key))
        jobs += [*warmups.values(), *branches, *wholes]
    return jobs


def _warmup(base: Job, arm: Arm) -> Job:
    """The warm-up of an arm's method, without prune and head; the same for all arms of the method."""
    name = f"{arm.method}-{WARM_UP}"
    options: dict[str, Words] = {
        "pipeline.model.pruning.mode": ("off",),
        "pipeline.model.head.mode": ("off",),
        "pipeline.model.stop-split-at": (str(arm.warmup),),
        "optimizers.means.scheduler.max-steps": (str(arm.total),),
        "schedule-length": (str(arm.total),),  # the first part of a whole run
    }
    key = f"{base.scene}-{name}-s{base.seed}"
    words = words_of(options)
    return replace(base, key=key, kind="warm-up", arm=name, method=arm.method, steps=arm.warmup, options=words)


def _job(base: Job, arm: Arm, ratio: float | None) -> Job:
    """The training of an arm at one share, or at its own."""
    steps, share = str(arm.steps), "" if ratio is None else f"{ratio:g}"
    options: dict[str, Words] = {} if ratio is None else {"pipeline.model.pruning.keep-ratio": (share,)}
    if arm.kind == "branch":
        options |= {
            "pipeline.model.pruning.seed": (str(base.seed),),
            # Rates decay over the branch.
            "optimizers.means.scheduler.max-steps": (steps,),
            "optimizers.compensation.scheduler.max-steps": (steps,),
            "pipeline.model.evaluate-prune": ("False",),
        }
    key = f"{base.scene}-{arm.name}-{'' if ratio is None else f'{100 * ratio:g}pct-'}s{base.seed}"
    made = replace(base, key=key, kind=arm.kind, arm=arm.name, method=arm.method, steps=arm.steps, keep_ratio=ratio)
    return replace(made, options=words_of({**options, **arm.options}))


def words_of(options: Mapping[str, Words]) -> Words:
    """Options of ``ns-train`` by name as words of its command line."""
    return tuple(word for name, words in options.items() for word in (f"--{name}", *words))


def _check(keep_ratios: Shares, seeds: Sequence[int], repeat_at: Shares, own: Shares) -> None:
    wrong = [ratio for ratio in keep_ratios if not 0 < ratio <= 1]
    if wrong:
        raise ConfigError(f"keep ratio {wrong[0]} cannot be; give shares in (0, 1], 0.1 for a tenth")
    if not keep_ratios or not seeds:
        raise ConfigError("there is nothing to do without a keep ratio and a seed; give one of each")
    if len(set(keep_ratios)) < len(keep_ratios) or len(set(seeds)) < len(seeds):
        raise ConfigError("the same keep ratio or seed is given twice; give each once")
    ratios = [*keep_ratios, *own]
    if len(seeds) > 1 and not set(repeat_at) & set(ratios):
        raise ConfigError(f"no keep ratio is repeated with other seeds; let --repeat-at name one of {ratios}")


def done_file(out: Path, key: str) -> Path:
    """File of a finished job's result: one line of JSON, so that files merge by concatenation."""
    return out / "done" / f"{key}.json"


def job_folder(out: Path, key: str) -> Path:
    """Folder of a job: its description, its log and its run."""
    return out / "jobs" / key
