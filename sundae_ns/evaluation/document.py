"""The report as a Markdown page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sundae_ns.evaluation.flip import VARIANT
from sundae_ns.evaluation.measured import MEGABYTE, Configuration, Measured
from sundae_ns.evaluation.published import NOTE, Printed

METRICS = (("psnr", 2), ("ssim", 4), ("flip", 4), ("lpips", 4))
"""Metrics of a table, in the order of its columns, with their decimals."""
_NONE = "-"


def number(value: float | None, digits: int) -> str:
    """A figure with so many decimals; a dash where there is none."""
    return _NONE if value is None or value != value else f"{value:,.{digits}f}"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], *, words: int = 2) -> list[str]:
    """Lines of a Markdown table; all columns but the first ``words`` stand to the right."""
    rule = ["---" if i < words else "---:" for i in range(len(heads))]
    return ["| " + " | ".join(cells).replace("\n", " ") + " |" for cells in (heads, rule, *rows)]


def _line(run: Measured, configuration: Configuration) -> list[str]:
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
    printed: Mapping[str, Sequence[Printed]],
    pictures: Mapping[str, Sequence[tuple[str, str]]],
    notes: Sequence[str],
    command: str,
) -> str:
    """The page.

    Args:
        scenes: measured fields by scene.
        printed: the paper's rows by scene; scenes without any may be left out.
        pictures: (title, file name beside the page) by scene, in order.
        notes: what was left out and why, a sentence each.
        command: what made the page.
    """
    lines = ["# Speed against error", "", f"    {command}", ""]
    runs = [run for own in scenes.values() for run in own]
    devices = sorted({run.gpu or "CPU" for run in runs})
    commits = sorted({run.commit for run in runs} - {""})
    lines += [
        f"Rendered on {', '.join(devices)}" + (f", commit {', '.join(commits)}." if commits else "."),
        "Each line is one way of rendering a field; its time and its errors are of the very same calls.",
        "Metrics are means over the test views: PSNR over all pixels and channels; SSIM of pytorch_msssim (11 x 11, valid",
        f"window); FLIP is {VARIANT}; LPIPS with the net that is named. ms: median over the views, device waited for.",
        "MB are 1e6 bytes in fp32 of all that this way of rendering needs: without the head neither network nor features;",
        "of a packed scene, the whole file.",
        "",
    ]
    nets = sorted({run.lpips_net for run in runs if run.full.mean("lpips") is not None})
    heads = ["run", "rendered with", "primitives", "MB", "ms a frame", "PSNR, dB", "SSIM", "FLIP"]
    heads.append(f"LPIPS ({', '.join(nets)})" if nets else "LPIPS")
    for scene, own in scenes.items():
        views = sorted({len(run.full.views) for run in own})
        sizes = sorted({run.resolution for run in own})
        lines += [f"## {scene}", "", f"{' or '.join(map(str, views))} test views, {' or '.join(sizes)} px.", ""]
        lines += table(heads, [_line(run, way) for run in own for way in run.configurations])
        if printed.get(scene):
            lines += ["", f"SUNDAE on {scene}, {NOTE}:", ""]
            lines += table(
                ["keep", "PSNR, dB", "SSIM", "LPIPS, net not named", "PSNR without head", "MB", "primitives"],
                [
                    [
                        _NONE if row.keep_ratio is None else f"{row.keep_ratio:.0%}",
                        *(number(v, d) for v, d in ((row.psnr, 2), (row.ssim, 3), (row.lpips, 3))),
                        *(number(v, d) for v, d in ((row.psnr_base, 2), (row.megabytes, 1), (row.primitives, 0))),
                    ]
                    for row in printed[scene]
                ],
                words=1,
            )
        for title, name in pictures.get(scene, ()):
            lines += ["", f"![{title}]({name})", "", f"*{title}.*"]
        lines.append("")
    if any(run.has_head for run in runs):
        lines += [
            "The head's gain is over the base colours of the same field, which was trained to carry a head. What a field",
            "trained without one would reach is another run: `sundae bench quality` makes it.",
            "",
        ]
    if notes:
        lines += ["## Left out", "", *(f"- {note}" for note in notes), ""]
    return "\n".join(lines)
