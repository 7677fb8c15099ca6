"""The report as a Markdown page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sundae_ns.evaluation.flip import VARIANT
from sundae_ns.evaluation.measured import MEGABYTE, Configuration, Measured

METRICS = (("psnr", 2), ("ssim", 4), ("flip", 4), ("lpips", 4))
"""Metrics in the order of a table's columns, with their number of decimals."""
_NONE = "-"


def number(value: float | None, digits: int) -> str:
    """A number with ``digits`` decimals; a dash for None and NaN."""
    return _NONE if value is None or value != value else f"{value:,.{digits}f}"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], *, words: int = 2) -> list[str]:
    """Lines of a Markdown table; the first ``words`` columns are aligned left, the others right."""
    rule = ["---" if i < words else "---:" for i in range(len(heads))]
    return ["| " + " | ".join(cells).replace("\n", " ") + " |" for cells in (heads, rule, *rows)]


def _row(run: Measured, configuration: Configuration) -> list[str]:
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
    """The page.

    Args:
        scenes: measured fields by scene.
        images: (title, file name beside the page) by scene, in order.
        notes: what was left out and why, one sentence each.
        command: the command that made the page.
    """
    lines = ["# Quality, speed and size", "", f"    {command}", ""]
    runs = [run for own in scenes.values() for run in own]
    devices = sorted({run.gpu or "CPU" for run in runs})
    lines += [
        f"Rendered on {', '.join(devices)}.",
        "",
        "- Each row is one configuration of rendering a field. Its time and its metrics come from the same calls.",
        "- Metrics are means over the test views. PSNR is over all pixels and channels, SSIM is pytorch_msssim's",
        f"  (11 x 11 window, no padding), FLIP is {VARIANT}, and LPIPS names its net.",
        "- Higher PSNR and SSIM are better; lower FLIP, LPIPS, ms and MB are better.",
        "- ms per frame is the median over the test views, synchronised with the device.",
        "- MB are 1e6 bytes in fp32 of all that the configuration needs: no network or features if the head is off.",
        "  For a packed scene it is the whole file.",
        "",
    ]
    nets = sorted({run.lpips_net for run in runs if run.full.mean("lpips") is not None})
    heads = ["run", "rendered with", "primitives", "MB", "ms per frame", "PSNR, dB", "SSIM", "FLIP"]
    heads.append(f"LPIPS ({', '.join(nets)})" if nets else "LPIPS")
    for scene, own in scenes.items():
        views = sorted({len(run.full.views) for run in own})
        sizes = sorted({run.resolution for run in own})
        lines += [f"## {scene}", "", f"{' or '.join(map(str, views))} test views, {' or '.join(sizes)} px.", ""]
        lines += table(heads, [_row(run, configuration) for run in own for configuration in run.configurations])
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
