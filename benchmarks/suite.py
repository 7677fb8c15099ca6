"""Measure all methods on every capture of a folder: quality, frames, training times, packed bytes. It resumes.

    python benchmarks/suite.py CAPTURES -o DIR

Whole methods train from scratch, one job at a time, so that their times are those of their commands. A job that shares
its GPU with another one has no times. Several commands may share DIR: its tables are of all their jobs.

A capture that is missing, damaged or too large for the GPU is named and left out; the exit code is then 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from harness.arms import choose_arms
from harness.plan import Arm, Job, Words, jobs_of_shard, parser_of, plan_scene
from harness.results import Result, group, mean_of, percent, quality_page, spread
from harness.run import Options, Runner, check_out, compare, first_jobs, run_script
from sundae_ns.core.errors import DataError
from sundae_ns.core.tables import MEGABYTE, number, table
from sundae_ns.io.pack.config import FINETUNE_STEPS
from sundae_ns.report.measured import METRICS

ARMS = (
    *("splatfacto", "sundae", "sundae-with-head", "sundae-no-head", "sundae-no-head-bytes"),
    *("band", "sundae-fast", "sundae-auto"),
)


@dataclass(frozen=True, kw_only=True)
class SuiteOptions(Options):
    """Options of the script; its folder is that of the captures."""

    script = "suite.py"
    arms: tuple[str, ...] = ARMS
    """files of arms (.yaml), and names of default arms, as of quality.py; those without options train from scratch."""
    scenes: tuple[str, ...] = ()
    """names of captures to measure; by default every folder in it."""
    downscale: int = 1
    """use the images of images_2, images_4 ... (COLMAP layout)."""


def run_suite(options: SuiteOptions, runner: Runner | None = None, console: Console | None = None) -> int:
    """Measure all methods on every capture of a folder; as ``run_quality``, and 1 if a capture is left out."""
    console = console or Console()
    arms = choose_arms(options.arms, options.method, options.steps_scale, from_scratch=True)
    check_out(options.out, reads=[options.folder])
    plan, left_out = plan_suite(options, arms)
    for scene, reason in left_out.items():
        console.print(f"[yellow]Left out: {escape(f'{scene}: {reason}')}", highlight=False, soft_wrap=True)
    captures = {key: scene for scene, key in first_jobs(jobs_of_shard(plan, options.shard)).items()}

    def page(results: Sequence[Result], failed: Mapping[str, str]) -> str:
        reasons = {captures.get(key, key): reason for key, reason in failed.items()}
        return suite_page(results, arms, {**left_out, **reasons}, options.command())

    code = compare(plan, options, page, runner, console, whole_captures=True)
    return code or int(bool(left_out))


def plan_suite(options: SuiteOptions, arms: Sequence[Arm]) -> tuple[list[Job], dict[str, str]]:
    """Jobs on the captures of a folder, and the reasons for which captures are left out, by name."""
    jobs: list[Job] = []
    left_out: dict[str, str] = {}
    for data in find_captures(options.folder, options.scenes):
        try:
            parser = parser_of(data, options.downscale)
            check(data, parser, options.method)
        except DataError as error:
            left_out[data.name] = str(error)
            continue
        shares = {"keep_ratios": options.keep_ratios, "repeat_at": options.repeat_at}
        jobs += plan_scene(data, parser, arms, seeds=options.seeds, **shares)
    return jobs, left_out


def find_captures(folder: Path, scenes: Sequence[str] = ()) -> list[Path]:
    """Folders of captures: all that are not hidden, or those named, whether they exist or not.

    Raises:
        DataError: the folder is missing, is a capture itself, or holds no folder.
    """
    if not folder.is_dir():
        raise DataError(f"{folder} is no folder; give the folder that holds the captures")
    if (folder / "sparse").is_dir() or (folder / "transforms.json").is_file():
        raise DataError(f"{folder} is a capture itself; give the folder that holds it, or use benchmarks/quality.py")
    names = scenes or sorted(path.name for path in folder.iterdir() if path.is_dir() and path.name[0] != ".")
    if not names:
        raise DataError(f"{folder} holds no capture; give the folder that holds the captures")
    return [folder.resolve() / name for name in names]


def check(data: Path, parser: Words, method: str) -> None:
    """Check a capture as a training by a method of this package does; ``DataError`` if it cannot be used."""
    # Late, since they load the trainer.
    from harness.job import parse
    from sundae_ns.plugin.dataparsers import check_capture

    config: Any = parse((method, "--data", str(data), *parser)).pipeline.datamanager
    check_capture(config.dataparser, data, ("train", "val"))


def suite_page(results: Sequence[Result], arms: Sequence[Arm], left_out: Mapping[str, str], command: str) -> str:
    """All captures: seconds of trainings, packed bytes, then the page of ``quality_page``."""
    lines = ["# All methods on every capture", ""]
    if left_out:
        lines += ["## Left out", ""]
        # The output of a training that failed ends with the cause.
        lines += [*(f"- {name}: {reason.splitlines()[-1]}" for name, reason in left_out.items()), ""]
    trained = [r for r in results if r["job"]["kind"] == "whole" and r["measured"]["train_s"] is not None]
    packed, tuned = ([result for result in results if result.get(name)] for name in ("packed", "tuned"))
    lines += [
        "## Training",
        "",
        "Trainings from scratch, each alone on its GPU; nothing is evaluated or saved meanwhile.",
        "",
        *_training(group(trained, arms)),
        "",
        "## Packing",
        "",
        "By the defaults of `sundae pack`; errors on all test views.",
        "",
        *_packing(group(packed, arms), "packed"),
    ]
    if tuned:
        lines += ["", f"With `--finetune {FINETUNE_STEPS}`, as `sundae run` packs on a GPU.", ""]
        lines += _packing(group(tuned, arms), "tuned")
    return "\n".join([*lines, "", quality_page(results, arms, command)])


def _training(groups: Mapping[tuple[str, str, float | None], Sequence[Result]]) -> list[str]:
    rows = []
    for (scene, arm, ratio), own in groups.items():
        measured = [result["measured"] for result in own]
        means = [run["configurations"][0]["mean"] for run in measured]
        rows.append(
            [
                *(scene, arm, percent(ratio), str(len(own)), f"{measured[0]['steps']:,}"),
                spread([run["train_s"] for run in measured], 0),
                *(spread([mean[metric] for mean in means], digits) for metric, digits in METRICS[:2]),
                spread([run["primitives"] for run in measured], 0),
                number(mean_of([run["peak_vram_mib"] for run in measured]), 0),
                ", ".join(sorted({run["gpu"] or "CPU" for run in measured})),
            ]
        )
    heads = ["capture", "arm", "keep", "seeds", "steps", "training, s", "PSNR, dB", "SSIM"]
    return table([*heads, "Gaussians", "MiB at most", "GPU"], rows)


def _packing(groups: Mapping[tuple[str, str, float | None], Sequence[Result]], name: str) -> list[str]:
    rows = []
    for (scene, arm, ratio), own in groups.items():
        means = [result["measured"]["configurations"][0]["mean"] for result in own]
        errors = [
            spread([figures[metric] for figures in place], digits)
            for metric, digits in METRICS[:2]
            for place in (means, [result[name] for result in own])
        ]
        count = spread([result["measured"]["primitives"] for result in own], 0)
        size = spread([result[name]["bytes"] / MEGABYTE for result in own], 2)
        rows.append([scene, arm, percent(ratio), str(len(own)), count, size, *errors])
    heads = ["capture", "arm", "keep", "seeds", "Gaussians", "packed, MB", "PSNR of the run", "packed"]
    return table([*heads, "SSIM of the run", "packed"], rows)


if __name__ == "__main__":
    run_script(SuiteOptions, __doc__, run_suite)
