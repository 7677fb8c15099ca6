"""Results of a comparison: read from their files, and written as rows and tables."""

from __future__ import annotations

import json
import shlex
import statistics
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from harness.plan import Arm
from sundae_ns.core.errors import DataError
from sundae_ns.core.files import write_text
from sundae_ns.core.tables import MEGABYTE, number, table
from sundae_ns.report.measure import METRICS, csv_text

Result = Mapping[str, Any]
"""Content of a file in ``done/``: the job's description as ``job``, its figures as ``measured``."""
Groups: TypeAlias = dict[tuple[str, str, float | None], list[Result]]


def read_results(out: Path) -> list[Result]:
    """All results in a folder, each job once: of ``done/``, and of ``*.jsonl`` beside it, which may be concatenated."""
    found: dict[str, Result] = {}
    for path in (*sorted(out.glob("*.jsonl")), *sorted((out / "done").glob("*.json"))):
        for count, line in enumerate(path.read_bytes().splitlines(), start=1):
            try:
                result = json.loads(line)
                found[result["job"]["key"]] = result
                _ = result["measured"]["configurations"]
            except (ValueError, KeyError, TypeError) as error:
                raise DataError(f"{path}, line {count} is no result of a bench ({error!r}); remove it") from error
    return list(found.values())


def write_results(out: Path, results: Sequence[Result], page: str) -> None:
    """Write ``results.jsonl``, ``results.csv`` with the columns of runs.csv, and ``table.md``."""
    write_text(out / "results.jsonl", "".join(json.dumps(result) + "\n" for result in results))
    write_text(out / "results.csv", csv_text([result["measured"] for result in results]))
    write_text(out / "table.md", page)


def group(results: Sequence[Result], arms: Sequence[Arm]) -> Groups:
    """Results by scene, arm and share, in their order; warm-ups first."""
    groups: Groups = {}
    for result in results:
        job = result["job"]
        groups.setdefault((job["scene"], job["arm"], job["keep_ratio"]), []).append(result)
    order = {arm.name: place for place, arm in enumerate(arms)}
    return dict(sorted(groups.items(), key=lambda item: (item[0][0], item[0][2] or -1.0, order.get(item[0][1], -1))))


def _alike(groups: Groups) -> Iterator[tuple[str, float | None, list[Result]]]:
    """Arm, share and results of each group, apart by whether a head came out: trials may differ between seeds."""
    for (_, arm, ratio), own in groups.items():
        for count in sorted({len(r["measured"]["configurations"]) for r in own}, reverse=True):
            yield arm, ratio, [r for r in own if len(r["measured"]["configurations"]) == count]


def percent(ratio: float | None) -> str:
    return "" if ratio is None else f"{100 * ratio:g}%"


def spread(values: Sequence[float | None], digits: int) -> str:
    """Mean and, of several, the standard deviation: ``29.03 ± 0.12``; a dash if one is missing."""
    mean = number(mean_of(values), digits)
    known = [value for value in values if value is not None]
    return mean if len(known) < max(len(values), 2) else f"{mean} ± {number(statistics.stdev(known), digits)}"


def mean_of(values: Sequence[float | None]) -> float | None:
    """Mean; None unless all values are known."""
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known and len(known) == len(values) else None


def quality_page(results: Sequence[Result], arms: Sequence[Arm]) -> str:
    """The comparison as a page: every way of rendering has a line, its time beside its error."""
    lines = ["# Comparison of quality", "", f"    {shlex.join(['python', *sys.argv])}", ""]
    lines += [
        "Mean over the seeds, ± their standard deviation. Arms that start from the warm-up of a method and a seed",
        "share it; its training comes before theirs. Time, MB and errors of a line are of one rendering. Times are",
        "of jobs that had their GPU to themselves.",
        "",
        *_described(arms),
    ]
    heads = ["arm", "rendered with", "keep", "seeds", "Gaussians", "PSNR, dB", "SSIM", "fitted, dB", "LPIPS", "MB"]
    heads += ["ms a frame", "training, s"]
    for scene in dict.fromkeys(result["job"]["scene"] for result in results):
        rows = []
        for arm, ratio, own in _alike(group([r for r in results if r["job"]["scene"] == scene], arms)):
            ways = [r["measured"]["configurations"] for r in own]
            for place in range(len(ways[0])):
                chosen = [way[place] for way in ways]
                head = "no head" if len(ways[0]) == 1 else chosen[0]["name"]
                rows.append(
                    [
                        *(arm, head, percent(ratio), str(len(own))),
                        spread([r["measured"]["primitives"] for r in own], 0),
                        *(spread([c["mean"].get(metric) for c in chosen], digits) for metric, digits in METRICS),
                        spread([c["bytes"] / MEGABYTE for c in chosen], 1),
                        spread([c["ms"] for c in chosen], 2),
                        spread([r["measured"]["train_s"] for r in own], 0) if place == 0 else "",
                    ]
                )
        of = [r["measured"] for r in results if r["job"]["scene"] == scene]
        where = sorted({m["gpu"] or "CPU" for m in of})
        lines += ["", f"## {scene}, {of[0]['resolution']} px, {', '.join(where)}", "", *table(heads, rows)]
    return "\n".join([*lines, ""])


def _described(arms: Sequence[Arm]) -> list[str]:
    """A line for each arm: its method, how it starts, and its options."""
    lines = []
    for arm in arms:
        options = "".join(f"; `{name} {' '.join(words)}`" for name, words in arm.options.items())
        start = "from the warm-up" if arm.kind == "branch" else "from scratch"
        lines.append(f"- `{arm.name}`: `{arm.method}` {start}, {arm.steps:,} steps{options}")
    return lines
