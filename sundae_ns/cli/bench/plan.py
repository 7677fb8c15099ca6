"""Comparisons as data: which jobs there are, what each needs, and which part of them a shard does. Nothing runs here."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sundae_ns.data.capture import how_to_make_one
from sundae_ns.errors import ConfigError, DataError

Kind = Literal["warm-up", "branch", "mcmc", "stock"]

PLAIN = ("--pipeline.model.pruning.edges", "centres", "--pipeline.model.pruning.redistribution", "none")

RULES: dict[str, tuple[str, ...]] = {
    "sundae": (),
    "band": (
        *("--pipeline.model.pruning.score", "response", "--pipeline.model.pruning.selection", "band"),
        *("--pipeline.model.pruning.signal", "positions", *PLAIN),
    ),
    "contribution": (
        *("--pipeline.model.pruning.score", "contribution", "--pipeline.model.pruning.selection", "top", *PLAIN),
    ),
    "random": ("--pipeline.model.pruning.score", "random", "--pipeline.model.pruning.selection", "sampled", *PLAIN),
}
"""Pruning rules by name, as options: ours; the paper's; the highest contribution, as LightGaussian prunes; the control."""

NO_HEAD = "-no-head"
PEERS = ("mcmc", "splatfacto", "splatfacto-7k")
ARMS = (*RULES, *(rule + NO_HEAD for rule in RULES), *PEERS)
"""What can be compared. Arms of a rule branch off the same warm-up, with the head or without."""

STOCK_STEPS, STOCK_SHORT = 30_000, 7_000


@dataclass(frozen=True)
class Job:
    """One training with its evaluation."""

    key: str
    """Name, one of a kind in a plan; also of its folder."""
    kind: Kind
    scene: str
    arm: str
    data: str
    """Folder of the capture."""
    method: str
    """What ``ns-train`` calls it."""
    steps: int
    seed: int
    keep_ratio: float | None = None
    """Share of the warm-up's primitives, for those that have one."""
    needs: str | None = None
    """Key of the warm-up that it starts from, or whose count it takes."""
    options: tuple[str, ...] = ()
    """Options of ``ns-train``."""
    parser: tuple[str, ...] = ()
    """The data parser and its options; empty for the method's own."""


@dataclass(frozen=True)
class Schedule:
    """Lengths of the parts of a comparison, in steps."""

    method: str
    """Method of ours that the warm-up and the branches take their options from."""
    warmup: int
    finetune: int
    stock: int = STOCK_STEPS
    stock_short: int = STOCK_SHORT

    def scaled(self, factor: float) -> Schedule:
        """All lengths times a factor, for a trial.

        Raises:
            ConfigError: the factor is not positive.
        """
        if not factor > 0:
            raise ConfigError(f"steps-scale is {factor}; give a positive factor, 0.01 for a trial")
        lengths = (self.warmup, self.finetune, self.stock, self.stock_short)
        return Schedule(self.method, *(max(round(length * factor), 1) for length in lengths))


def schedule_of(method: str, *, warmup: int | None, finetune: int | None, scale: float) -> Schedule:
    """Lengths of a method of ours, unless they are given.

    Raises:
        ConfigError: there is no such method of ours that prunes once, or a length is not positive.
    """
    # Late, since it loads nerfstudio; in an editable install it lies where type checkers do not look.
    methods = importlib.import_module("sundae_ns.method_configs")
    specification = getattr(methods, method.replace("-", "_"), None)
    if specification is None or specification.config.pipeline.model.pruning.mode != "one-shot":
        raise ConfigError(f"{method!r} is no method of ours that prunes once; use sundae, or sundae-tiny for a trial")
    config = specification.config
    prune_at = config.pipeline.model.pruning.prune_at
    warmup = prune_at if warmup is None else warmup
    finetune = config.max_num_iterations - prune_at if finetune is None else finetune
    if warmup < 1 or finetune < 1:
        raise ConfigError(f"{warmup} steps of warm-up and {finetune} of fine-tuning; give at least 1 of each")
    return Schedule(method, warmup, finetune).scaled(scale)


def parser_of(data: Path, downscale: int = 1) -> tuple[str, ...]:
    """Data parser for the layout of a capture's folder, and its options; every eighth picture for test, as papers measure.

    Args:
        data: with ``sparse/0`` and ``images`` (COLMAP), or with a ``transforms.json`` (its own split).
        downscale: takes pictures and cameras smaller by this, from ``images_2``, ``images_4`` ... (COLMAP alone).

    Returns:
        Words of the command line; none for the method's own parser.

    Raises:
        ConfigError: smaller pictures of a capture that is not in COLMAP layout.
        DataError: neither layout, or no such pictures.
    """
    if (data / "sparse" / "0").is_dir():
        pictures = data / ("images" if downscale == 1 else f"images_{downscale}")
        if not pictures.is_dir():
            raise DataError(f"{pictures} does not exist; unpack all of the capture, or give another --downscale")
        # Published smaller pictures are rounded to the nearest pixel.
        return (
            *("colmap", "--colmap-path", "sparse/0", "--downscale-factor", str(downscale)),
            *("--downscale-rounding-mode", "round", "--eval-mode", "interval", "--eval-interval", "8"),
        )
    if (data / "transforms.json").is_file():
        if downscale != 1:
            raise ConfigError("--downscale is for captures in COLMAP layout; transforms.json names its own pictures")
        return ()
    if not data.is_dir():
        raise DataError(f"{data} is no folder; give the folder of a capture")
    raise DataError(f"{data} is no capture: it has neither sparse/0 nor transforms.json; {how_to_make_one(data)}")


def plan_scene(
    scene: str,
    data: Path,
    parser: Sequence[str],
    schedule: Schedule,
    *,
    arms: Sequence[str],
    keep_ratios: Sequence[float],
    seeds: Sequence[int],
    repeat_at: Sequence[float],
) -> list[Job]:
    """All jobs on one capture, warm-ups before what needs them.

    Args:
        scene: its name in tables.
        data: its folder.
        parser: from :func:`parser_of`.
        schedule: lengths.
        arms: of :data:`ARMS`.
        keep_ratios: shares of the primitives to keep.
        seeds: the first is for everything; the others repeat what is at ``repeat_at``, from warm-ups of their own.
        repeat_at: shares for which all seeds are run.

    Raises:
        ConfigError: an arm, share or seed that cannot be.
    """
    _check(arms, keep_ratios, seeds, repeat_at)
    # The same for all jobs on this capture.
    where = {"scene": scene, "data": str(data), "parser": tuple(parser)}
    total = schedule.warmup + schedule.finetune
    jobs: list[Job] = []
    for number, seed in enumerate(seeds):
        ratios = [ratio for ratio in keep_ratios if number == 0 or ratio in repeat_at]
        warmup = Job(
            key=f"{scene}-warm-up-s{seed}",
            kind="warm-up",
            arm="warm-up",
            method=schedule.method,
            steps=schedule.warmup,
            seed=seed,
            options=(
                *("--pipeline.model.pruning.mode", "off", "--pipeline.model.head.mode", "off"),
                *("--pipeline.model.stop-split-at", str(schedule.warmup)),
                *("--optimizers.means.scheduler.max-steps", str(total)),
            ),
            **where,  # type: ignore[arg-type]
        )
        branches: list[Job] = []
        for ratio in ratios:
            for arm in arms:
                if arm.startswith("splatfacto"):
                    continue
                common = {"arm": arm, "seed": seed, "keep_ratio": ratio, "needs": warmup.key, **where}
                key = f"{scene}-{arm}-{100 * ratio:g}pct-s{seed}"
                if arm == "mcmc":
                    options = _mcmc_options(total)
                    branches.append(Job(key, "mcmc", method=schedule.method, steps=total, options=options, **common))  # type: ignore[arg-type]
                else:
                    options = _branch_options(arm, ratio, seed, schedule.finetune)
                    branches.append(
                        Job(key, "branch", method=schedule.method, steps=schedule.finetune, options=options, **common)  # type: ignore[arg-type]
                    )
        if branches:
            jobs += [warmup, *branches]
        if ratios:
            for arm, steps in (("splatfacto", schedule.stock), ("splatfacto-7k", schedule.stock_short)):
                if arm in arms:
                    key = f"{scene}-{arm}-s{seed}"
                    jobs.append(Job(key, "stock", arm=arm, method="splatfacto", steps=steps, seed=seed, **where))  # type: ignore[arg-type]
    return jobs


def _branch_options(arm: str, ratio: float, seed: int, steps: int) -> tuple[str, ...]:
    rule = arm.removesuffix(NO_HEAD)
    head = ("--pipeline.model.head.mode", "off") if arm.endswith(NO_HEAD) else ()
    return (
        *("--pipeline.model.pruning.keep-ratio", f"{ratio:g}", "--pipeline.model.pruning.seed", str(seed)),
        # Rates decay over the branch.
        *("--optimizers.means.scheduler.max-steps", str(steps)),
        *("--optimizers.compensation.scheduler.max-steps", str(steps)),
        *("--pipeline.model.evaluate-prune", "False"),
        *RULES[rule],
        *head,
    )


def _mcmc_options(steps: int) -> tuple[str, ...]:
    return (
        *("--pipeline.model.warmup", "mcmc"),
        *("--pipeline.model.pruning.mode", "off", "--pipeline.model.head.mode", "off"),
        # The share of its authors: 25,000 of 30,000.
        *("--pipeline.model.stop-split-at", str(max(steps * 5 // 6, 1))),
        *("--optimizers.means.scheduler.max-steps", str(steps)),
    )


def _check(arms: Sequence[str], keep_ratios: Sequence[float], seeds: Sequence[int], repeat_at: Sequence[float]) -> None:
    odd = [arm for arm in arms if arm not in ARMS]
    if odd or not arms:
        raise ConfigError(f"{', '.join(odd) or 'nothing'} is no arm; use some of {', '.join(ARMS)}")
    for ratio in keep_ratios:
        if not 0 < ratio <= 1:
            raise ConfigError(f"keep ratio {ratio} cannot be; give shares in (0, 1], 0.1 for a tenth")
    if not keep_ratios or not seeds:
        raise ConfigError("there is nothing to do without a keep ratio and a seed; give one of each")
    for name, values in (("arm", arms), ("keep ratio", keep_ratios), ("seed", seeds)):
        if len(set(values)) < len(values):
            raise ConfigError(f"the same {name} is given twice; give each once")
    missing = [ratio for ratio in repeat_at if ratio not in keep_ratios]
    if len(seeds) > 1 and missing == list(repeat_at):
        raise ConfigError(
            f"no keep ratio is repeated with other seeds; let --repeat-at name one of {list(keep_ratios)}"
        )


def jobs_of_shard(jobs: Sequence[Job], index: int, parts: int) -> list[Job]:
    """The jobs of part ``index``, counted from 0, with the warm-ups that they need; parts share nothing but those.

    Warm-ups are not dealt out: a part makes those that are not there yet, and finds the others finished.
    """
    own = [job for job in jobs if job.kind != "warm-up"][index::parts]
    keys = {job.key for job in own} | {job.needs for job in own}
    return [job for job in jobs if job.key in keys]


def done_file(out: Path, key: str) -> Path:
    """Where the result of a finished job lies: one line of JSON, so that files merge by concatenation."""
    return out / "done" / f"{key}.json"


def job_folder(out: Path, key: str) -> Path:
    """Where a job keeps its description, its log and its run."""
    return out / "jobs" / key
