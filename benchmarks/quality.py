"""Compare methods and options on one capture: train and evaluate each arm. Stopped, the same command resumes.

    python benchmarks/quality.py CAPTURE -o DIR
    python benchmarks/quality.py CAPTURE -o DIR --arms MINE.yaml sundae --keep-ratios 0.1 --seeds 42

MINE.yaml has arms of your own, as benchmarks/harness/arms.yaml has the default ones: a list of names, each with a
method of ns-train (of this package, or splatfacto) and options of ns-train, if it needs them.

Methods that prune once share a warm-up of each seed, and prune at every share of --keep-ratios. Other methods train
from scratch. Methods and options are checked before anything is trained.

Every finished job is a file of one line in DIR/done. Commands with other arms or seeds may run side by side, in one
folder, or in several whose results.jsonl are concatenated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from harness.arms import choose_arms
from harness.plan import parser_of, plan_scene
from harness.results import Result, quality_page
from harness.run import Options, check_out, compare, run_script


@dataclass(frozen=True, kw_only=True)
class QualityOptions(Options):
    """Options of the script."""

    keep_ratios: tuple[float, ...] = (0.01, 0.1)
    seeds: tuple[int, ...] = (42, 43, 44)


def run_quality(options: QualityOptions) -> int:
    """Compare arms on one capture; the exit code."""
    arms = choose_arms(options.arms, options.method, options.steps_scale)
    check_out(options.out, reads=[options.folder])
    data = options.folder.resolve()
    shares = {"keep_ratios": options.keep_ratios, "repeat_at": options.repeat_at}
    plan = plan_scene(data, parser_of(data, options.downscale), arms, seeds=options.seeds, **shares)

    def page(results: Sequence[Result], _: object) -> str:
        return quality_page(results, arms)

    return compare(plan, options.out, page)


if __name__ == "__main__":
    run_script(QualityOptions, __doc__, run_quality)
