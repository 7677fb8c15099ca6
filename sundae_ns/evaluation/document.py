"""Measured runs as a Markdown page, as a plain-text table, and as rows of a CSV file."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from io import StringIO
from textwrap import wrap
from typing import Any

from rich.console import Console
from rich.table import Table

from sundae_ns.evaluation.jod import JOD_VARIANT
from sundae_ns.evaluation.measured import MEGABYTE, Configuration, Measured
from sundae_ns.evaluation.metrics import FLIP_VARIANT

METRICS = (("psnr", 2), ("ssim", 4), ("psnr_fitted", 2), ("flip", 4), ("lpips", 4), ("jod", 3))
"""Metrics in the order of a table's columns, with their number of decimals."""
Stage = tuple[str, int, Mapping[str, float] | None]
"""Name of a stage of a run, number of primitives, and means over the test views by name; None for a skipped stage."""
EXPLANATIONS = (
    "Each row is one configuration of rendering a field. Its time and its metrics come from the same calls.",
    "Metrics are means over the test views. PSNR is over all pixels and channels; fitted, it is taken after the "
    "affine map of colours that brings the image nearest to its photo, so that changing light counts less. SSIM is "
    f"pytorch_msssim's (11 x 11 window, no padding), FLIP is {FLIP_VARIANT}, and LPIPS names its net.",
    f"JOD is {JOD_VARIANT}: 10 for equal images, and three of four viewers see 1 less.",
    "Higher PSNR, SSIM and JOD are better; lower FLIP, LPIPS, ms and MB are better.",
    "ms per frame is the median over the test views, synchronised with the device.",
    "MB are 1e6 bytes in fp32 of all that the configuration needs: no network or features if the head is off. "
    "For a packed scene it is the whole file.",
)
"""Sentences on the figures of a report's table."""
COLUMNS = (
    *("scene", "method", "variant", "keep_ratio", "seed", "steps", "primitives"),
    *("psnr", "ssim", "psnr_base", "ssim_base", "psnr_fitted", "lpips", "lpips_net"),
    *("bytes_primitives", "bytes_head", "bytes_total", "ms_frame", "ms_splat", "ms_head"),
    *("train_s", "prune_s", "peak_primitives", "peak_vram_mib", "gpu", "resolution", "fingerprint", "command"),
)
"""Metrics are means over the test views, ``*_base`` without the head; ``bytes_*`` are bytes, ``ms_*`` milliseconds per
frame, ``*_s`` seconds, and ``peak_vram_mib`` is the peak that torch allocated during training, MiB; ``fingerprint``
stands for the options of the run."""


def number(value: float | None, digits: int) -> str:
    """A number with ``digits`` decimals; a dash for None and NaN."""
    return "-" if value is None or value != value else f"{value:,.{digits}f}"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], *, words: int = 2) -> list[str]:
    """Lines of a Markdown table; the first ``words`` columns are aligned left, the others right."""
    rule = ["---" if i < words else "---:" for i in range(len(heads))]
    return ["| " + " | ".join(cells).replace("\n", " ") + " |" for cells in (heads, rule, *rows)]


def heads_of(runs: Sequence[Measured]) -> list[str]:
    """Heads of the table of the runs of a report; LPIPS names the nets that the runs have."""
    nets = sorted({run.lpips_net for run in runs if run.full.mean("lpips") is not None})
    heads = ["run", "rendered with", "primitives", "MB", "ms per frame", "PSNR, dB", "SSIM", "fitted, dB", "FLIP"]
    return [*heads, f"LPIPS ({', '.join(nets)})" if nets else "LPIPS", "JOD"]


def devices_of(runs: Sequence[Measured]) -> str:
    """Names of the devices that rendered the runs."""
    return ", ".join(sorted({run.gpu or "CPU" for run in runs}))


def row_of(run: Measured, configuration: Configuration) -> list[str]:
    """Cells of a configuration below :func:`heads_of`."""
    return [
        run.label,
        configuration.name if run.has_head else "no head",
        number(run.primitives, 0),
        number(configuration.bytes / MEGABYTE, 2),
        number(configuration.ms, 2),
        *(number(configuration.mean(metric), digits) for metric, digits in METRICS),
    ]


def document(
    scenes: Mapping[str, Sequence[Measured]],
    images: Mapping[str, Sequence[tuple[str, str]]],
    notes: Sequence[str],
    command: str,
) -> str:
    """The Markdown page.

    Args:
        scenes: measured fields by scene.
        images: (title, file name beside the page) by scene, in order.
        notes: what was left out and why, one sentence each.
        command: the command that made the page.
    """
    lines = ["# Quality, speed and size", "", f"    {command}", ""]
    runs = [run for own in scenes.values() for run in own]
    lines += [
        f"Rendered on {devices_of(runs)}.",
        "",
        *("\n".join(wrap(f"- {line}", 120, subsequent_indent="  ")) for line in EXPLANATIONS),
        "",
    ]
    heads = heads_of(runs)
    for scene, own in scenes.items():
        views = sorted({len(run.full.views) for run in own})
        sizes = sorted({run.resolution for run in own})
        lines += [f"## {scene}", "", f"{' or '.join(map(str, views))} test views, {' or '.join(sizes)} px.", ""]
        lines += table(heads, [row_of(run, configuration) for run in own for configuration in run.configurations])
        for title, name in images.get(scene, ()):
            lines += ["", f"![{title}]({name})", "", f"*{title}.*"]
        lines.append("")
    if any(run.has_head for run in runs):
        lines += [
            "With the head off, the same field shows its base colours, although it was trained with a head. To train a",
            "field without a head is another run, with `--pipeline.model.head.mode off`.",
            "",
        ]
    if notes:
        lines += ["## Left out", "", *(f"- {note}" for note in notes), ""]
    return "\n".join(lines)


def report_text(title: str, stages: Sequence[Stage], sizes: tuple[int, int], times: tuple[float, float, float]) -> str:
    """Tables of quality and cost as text, at most 100 characters wide.

    Args:
        title: of the tables.
        stages: from the full field to the final one.
        sizes: bytes of the primitives and of the head.
        times: milliseconds of splatting, of the head, and of the whole frame.
    """
    quality = Table(title=f"{title}: quality on the test views", title_justify="left")
    quality.add_column("stage")
    for column in ("primitives", "PSNR, dB", "SSIM", "LPIPS"):
        quality.add_column(column, justify="right")
    for stage, primitives, metrics in stages:
        if metrics:
            cells = (number(metrics.get(name), digits) for name, digits in (("psnr", 2), ("ssim", 4), ("lpips", 4)))
            quality.add_row(stage, f"{primitives:,}", *cells)

    kept = stages[-1][1] / max(stages[0][1], 1)
    cost = Table(title=f"Cost ({100 * kept:.1f}% of the primitives kept)", title_justify="left")
    cost.add_column("")
    for column in ("primitives", "head", "total"):
        cost.add_column(column, justify="right")
    cost.add_row("size, MB (1e6 bytes)", *(number(size / MEGABYTE, 2) for size in (*sizes, sum(sizes))))
    cost.add_row("time per frame, ms", *(number(value, 2) for value in times))

    console = Console(file=StringIO(), width=100, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(quality, cost)
    return "\n".join(line.rstrip() for line in capture.get().splitlines())


def csv_text(runs: Sequence[Mapping[str, Any]]) -> str:
    """Runs of :meth:`sundae_ns.evaluation.Measured.as_json` as CSV; an empty cell means not measured."""
    buffer = StringIO()
    writer = csv.DictWriter(buffer, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for run in runs:
        full, base = run["configurations"][0], run["configurations"][-1]
        # Each time stands beside the metrics of its own renderings.
        own = {"ms_frame": full["ms"], "ms_splat": base["ms"], **full["mean"]}
        own |= {"psnr_base": base["mean"]["psnr"], "ssim_base": base["mean"]["ssim"]}
        own["lpips_net"] = run["lpips_net"] if own["lpips"] is not None else ""
        writer.writerow({**run, **own})
    return buffer.getvalue()
