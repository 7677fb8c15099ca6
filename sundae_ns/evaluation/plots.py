"""Plots of a report. Each function draws the runs that it is given and writes one file, without global matplotlib state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from matplotlib.transforms import Bbox

from sundae_ns.evaluation.colors import PALETTE
from sundae_ns.evaluation.measured import MEGABYTE
from sundae_ns.evaluation.published import NOTE, Printed

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from sundae_ns.evaluation.curves import Curve, Curves
    from sundae_ns.evaluation.measured import Configuration, Measured

Cost = Literal["size", "time", "primitives"]

DPI = 110
MOST_SERIES = len(PALETTE)
"""Most runs in a plot whose lines only their colour tells apart."""
_GRAY, _INK = "0.35", "0.15"
_GRID = {"alpha": 0.3, "linewidth": 0.6}
_SMOOTHING = 30
"""The window of a running median reaches 1/30 of the run to both sides."""
_FAINT_RUNS = 2
"""Most runs whose values at single steps are drawn behind their medians; more would hide each other."""

_COSTS: Mapping[Cost, tuple[str, str]] = {
    "size": ("megabytes", "size, MB (smaller is better)"),
    "time": ("ms", "time per frame, ms (smaller is better)"),
    "primitives": ("primitives", "number of primitives (smaller is better)"),
}
_METRICS = (("psnr", "PSNR, dB (higher is better)"), ("ssim", "SSIM (higher is better)"))


@dataclass(frozen=True)
class CostPoint:
    """One rendering in a plot of quality against cost; None is a value that was not measured."""

    label: str
    """Name of the run, drawn beside its first point. Points with the same label are connected."""
    psnr: float | None
    """dB."""
    ssim: float | None = None
    megabytes: float | None = None
    ms: float | None = None
    """Milliseconds per frame."""
    primitives: int | None = None
    source: Literal["head on", "head off", "paper"] = "head on"
    """Rendered with the head, rendered without a head, or printed in the paper: a filled dot, a circle, a cross."""


def points_of(run: Measured) -> list[CostPoint]:
    """The configurations of a run as points of a plot."""

    def point(configuration: Configuration) -> CostPoint:
        return CostPoint(
            run.label,
            psnr=configuration.mean("psnr"),
            ssim=configuration.mean("ssim"),
            megabytes=configuration.bytes / MEGABYTE,
            ms=configuration.ms,
            primitives=run.primitives,
            source="head on" if run.has_head and configuration is run.full else "head off",
        )

    return [point(configuration) for configuration in run.configurations]


def printed_point(row: Printed) -> CostPoint:
    """A row of the paper as a point of a plot. Its time is left out: it comes from another machine."""
    return CostPoint(
        f"paper, {row.keep_ratio:.0%}",
        psnr=row.psnr,
        ssim=row.ssim,
        megabytes=row.megabytes,
        primitives=row.primitives,
        source="paper",
    )


def colors_of(labels: Sequence[str]) -> dict[str, str]:
    """The colour of each label, the same in all plots of a report. Colours repeat after :data:`MOST_SERIES` labels."""
    return {label: PALETTE[i % len(PALETTE)] for i, label in enumerate(labels)}


def plot_quality(path: Path, points: Sequence[CostPoint], cost: Cost, colors: Mapping[str, str], *, title: str) -> bool:
    """PSNR and SSIM against a cost; each run's name stands beside its point.

    Args:
        path: the file to write.
        points: all of one scene; points without this cost are left out.
        cost: the horizontal axis: size in MB, time in ms per frame, or number of primitives.
        colors: from :func:`colors_of`; the paper's points are gray.
        title: of the figure.

    Returns:
        Whether there was a point to plot; otherwise no file is written.
    """
    attribute, cost_label = _COSTS[cost]
    known = [point for point in points if getattr(point, attribute) is not None]
    metrics = [metric for metric in _METRICS if any(getattr(point, metric[0]) is not None for point in known)]
    if not metrics:
        return False
    figure, panels = _figure(1, len(metrics), width=5.4, height=4.2)
    names = []
    for panel, (metric, metric_label) in zip(panels[0], metrics, strict=True):
        drawn = [
            (point, float(getattr(point, attribute)), float(getattr(point, metric)))
            for point in known
            if getattr(point, metric) is not None
        ]
        by_label: dict[str, list[tuple[float, float]]] = {}
        for point, x, y in drawn:
            by_label.setdefault(point.label, []).append((x, y))
            _dot(panel, point.source, _GRAY if point.source == "paper" else colors[point.label], x, y)
        for label, places in by_label.items():
            panel.plot(*zip(*places, strict=True), color=colors.get(label, _GRAY), linewidth=1, alpha=0.6)
        _cost_axis(panel, [x for _, x, _ in drawn])
        panel.set_xlabel(cost_label)
        panel.set_ylabel(metric_label)
        names.append([_Name(label, colors.get(label, _GRAY), places) for label, places in by_label.items()])
    meanings = {"head on": "with the head", "head off": "without the head", "paper": f"SUNDAE, {NOTE}"}
    sources = [source for source in meanings if any(point.source == source for point in known)]
    if sources != ["head on"]:
        _legend(figure, [_key(source, meanings[source]) for source in sources])
    figure.suptitle(title, fontsize=11)
    _write_names(figure, dict(zip(panels[0], names, strict=True)))
    figure.savefig(path)
    return True


def plot_gain(path: Path, runs: Sequence[Measured], colors: Mapping[str, str]) -> bool:
    """Gain in PSNR and SSIM by the head against the milliseconds that it adds.

    Args:
        path: the file to write.
        runs: all of one scene.
        colors: from :func:`colors_of`.

    Returns:
        Whether there was a timed run with a head; otherwise no file is written.
    """
    figure, panels = _figure(1, 2, width=5.4, height=4.2)
    names: list[list[_Name]] = []
    for panel, metric, title in zip(panels[0], ("psnr", "ssim"), ("PSNR, dB", "SSIM"), strict=True):
        names.append([])
        for run in runs:
            with_head, without, ms, ms_base = run.full.mean(metric), run.base.mean(metric), run.full.ms, run.base.ms
            if not run.has_head or with_head is None or without is None or ms is None or ms_base is None:
                continue
            place = ms - ms_base, with_head - without
            _dot(panel, "head on", colors[run.label], *place)
            names[-1].append(_Name(run.label, colors[run.label], [place]))
        panel.axhline(0, color="0.4", linewidth=0.8)
        panel.axvline(0, color="0.4", linewidth=0.8)
        panel.margins(0.2)
        panel.set_xlabel("added time per frame, ms (smaller is better)")
        panel.set_ylabel(f"gain in {title} (higher is better)")
    if not any(names):
        return False
    figure.suptitle(f"{runs[0].scene}: gain by the head over the base colours of the same field", fontsize=11)
    _write_names(figure, dict(zip(panels[0], names, strict=True)))
    figure.savefig(path)
    return True


def plot_views(path: Path, runs: Sequence[Measured], colors: Mapping[str, str]) -> None:
    """PSNR of every test view; solid lines with the head, dashed lines without it.

    Args:
        path: the file to write.
        runs: of one scene, at most :data:`MOST_SERIES`.
        colors: from :func:`colors_of`.
    """
    count = max(len(run.full.views) for run in runs)
    figure, panels = _figure(1, 1, width=min(7 + 0.12 * count, 16), height=3.8)
    panel = panels[0, 0]
    for run in runs:
        for configuration in run.configurations:
            full = configuration is run.full
            panel.plot(
                range(len(configuration.views)),
                [view.psnr for view in configuration.views],
                color=colors[run.label],
                linestyle="-" if full else "--",
                marker="o" if full else None,
                markersize=4,
                linewidth=1.3 if full else 1,
                alpha=1 if full else 0.6,
            )
    panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    panel.set_xlabel("test view, in the order of the capture")
    panel.set_ylabel("PSNR, dB (higher is better)")
    handles = [Line2D([], [], color=colors[run.label], marker="o", markersize=4, label=run.label) for run in runs]
    if any(run.has_head for run in runs):
        handles.append(Line2D([], [], color="0.4", linestyle="--", label="same field, head off"))
    _legend(figure, handles)
    figure.suptitle(f"{runs[0].scene}: PSNR of each test view", fontsize=11)
    figure.savefig(path)


def plot_curves(path: Path, curves: Mapping[str, Curves], colors: Mapping[str, str], *, title: str) -> None:
    """Loss, number of primitives, PSNR of training views, and peak memory over training.

    Args:
        path: the file to write.
        curves: by label; at least one and at most :data:`MOST_SERIES`.
        colors: from :func:`colors_of`.
        title: of the figure.
    """
    figure, panels = _figure(2, 2, width=5.6, height=3.2)
    titles = (
        "training loss (lower is better)",
        "number of primitives",
        "training PSNR, dB (higher is better)",
        "peak GPU memory, MiB",
    )
    for panel, label in zip(panels.flat, titles, strict=True):
        panel.set_ylabel(label, fontsize=9)
        panel.set_xlabel("training step")
        panel.xaxis.set_major_formatter(FuncFormatter(_number))
    loss, count, psnr, memory = panels.flat
    faint = len(curves) <= _FAINT_RUNS
    without_head = False
    for label, run in curves.items():
        _noisy(loss, run.loss, colors[label], faint)
        # Steps, not slopes: a prune is instantaneous.
        count.plot(
            run.primitives.steps, run.primitives.values, color=colors[label], linewidth=1.3, drawstyle="steps-post"
        )
        _noisy(psnr, run.psnr, colors[label], faint)
        if run.psnr_base.values != run.psnr.values:
            without_head = True
            _noisy(psnr, run.psnr_base, colors[label], False, linestyle="--")
        if any(run.memory.values):
            memory.plot(run.memory.steps, run.memory.values, color=colors[label], linewidth=1.3)
    loss.set_yscale("log")
    loss.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    loss.yaxis.set_major_formatter(FuncFormatter(_number))
    loss.yaxis.set_minor_formatter(NullFormatter())
    count.yaxis.set_major_formatter(FuncFormatter(_number))
    count.set_ylim(bottom=0)
    if memory.lines:
        memory.set_ylim(bottom=0)
    else:
        memory.text(0.5, 0.5, "not recorded (no CUDA device)", transform=memory.transAxes, ha="center", color="0.5")
        memory.set(xticks=[], yticks=[])
    handles = [Line2D([], [], color=colors[label], label=label) for label in curves]
    if without_head:
        handles.append(Line2D([], [], color="0.4", linestyle="--", label="PSNR without the head"))
    _legend(figure, handles)
    figure.suptitle(f"{title} (loss and PSNR are running medians; each step has another view)", fontsize=11)
    figure.savefig(path)


def _figure(rows: int, columns: int, *, width: float, height: float) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(width * columns, height * rows + 0.6), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False)
    for panel in panels.flat:
        panel.grid(**_GRID)
        panel.spines[["top", "right"]].set_visible(False)
    return figure, panels


def _legend(figure: Figure, handles: Sequence[Any]) -> None:
    # Below the panels, where it hides no data.
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 3), fontsize=8, frameon=False)


def _dot(panel: Axes, source: str, color: str, x: float, y: float) -> None:
    if source == "paper":
        panel.scatter(x, y, marker="X", color=color, s=55, linewidths=0, zorder=4)
    else:
        face = color if source == "head on" else "white"
        panel.scatter(x, y, marker="o", s=48, linewidths=1.6, zorder=3, facecolor=face, edgecolor=color)


def _key(source: str, text: str) -> Line2D:
    """Entry of a legend that explains the markers of :func:`_dot`."""
    face = "white" if source == "head off" else _GRAY
    marker = "X" if source == "paper" else "o"
    return Line2D([], [], color=_GRAY, marker=marker, markerfacecolor=face, linestyle="none", label=text)


class _Name(NamedTuple):
    """A name to write beside the first of the points that it belongs to."""

    text: str
    color: str
    places: Sequence[tuple[float, float]]
    """Points in data coordinates, connected in this order."""


_DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
_DISTANCES = (7, 14, 24, 36, 50)
"""Distances of a name from its point, in points of 1/72 inch; the nearest that is free is taken."""


def _write_names(figure: Figure, names: Mapping[Axes, Sequence[_Name]]) -> None:
    """Write each name beside its point in its panel, where it covers neither a point, a line nor another name."""
    figure.draw_without_rendering()  # the final layout maps data coordinates to pixels
    for panel, own in names.items():
        _write_names_in(panel, own, figure.dpi / 72)


def _write_names_in(panel: Axes, names: Sequence[_Name], scale: float) -> None:
    inside, taken = panel.get_window_extent(), []
    for name in names:
        pixels = panel.transData.transform(name.places)
        taken += [_box(pixel, 5 * scale) for pixel in pixels]
        for start, end in zip(pixels, pixels[1:]):
            taken += _boxes_along(start, end)
    for name in names:
        point = panel.transData.transform(name.places[0])
        text = panel.annotate(name.text, name.places[0], fontsize=8)
        size = np.array(text.get_window_extent().size)
        text.remove()
        best, least = (point, 0), np.inf
        for distance in _DISTANCES:
            for right, up in _DIRECTIONS:
                # The middle of the text, so that its near edge lies at the distance from the point.
                dx = right * (distance * scale / (1.4 if up else 1) + size[0] / 2)
                dy = up * (distance * scale / (1.4 if right else 1) + size[1] / 2)
                middle = point + (dx, dy)
                box = Bbox([middle - size / 2, middle + size / 2])
                cover = sum(_overlap(box, other) for other in taken) + box.width * box.height - _overlap(box, inside)
                if cover < least:
                    best, least = (middle, distance), cover
        middle, distance = best
        taken.append(Bbox([middle - size / 2, middle + size / 2]))
        line = {"arrowstyle": "-", "color": name.color, "linewidth": 0.6, "shrinkA": 0, "shrinkB": 4}
        far = distance > _DISTANCES[0]
        if far:
            taken += _boxes_along(point, middle)
        written = panel.annotate(
            name.text,
            name.places[0],
            (middle - point) / scale,
            textcoords="offset points",
            fontsize=8,
            color=_INK,
            ha="center",
            va="center",
            arrowprops=line if far else None,
        )
        written.set_in_layout(False)


def _box(middle: np.ndarray, reach: float) -> Bbox:
    return Bbox([middle - reach, middle + reach])


def _boxes_along(start: np.ndarray, end: np.ndarray) -> list[Bbox]:
    """Small boxes that cover the line between two pixels."""
    return [_box(start + share * (end - start), 1) for share in np.linspace(0, 1, 40)]


def _overlap(a: Bbox, b: Bbox) -> float:
    """Area that two boxes share, square pixels."""
    width, height = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
    return max(width, 0.0) * max(height, 0.0)


def _number(value: float, _: object = None) -> str:
    """A short tick label, such as ``350k`` or ``1.5M``."""
    for unit, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= unit:
            return f"{value / unit:g}{letter}"
    return f"{value:g}"


def _cost_axis(panel: Axes, values: Sequence[float]) -> None:
    """Choose a linear axis for values within a factor of 4, else a logarithmic one, with readable ticks."""
    panel.margins(0.2)
    panel.xaxis.set_major_formatter(FuncFormatter(_number))
    if min(values) <= 0 or max(values) / min(values) < 4:
        panel.xaxis.set_major_locator(MaxNLocator(6))
        return
    panel.set_xscale("log")
    span = max(values) / min(values)
    panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if span < 100 else (1, 3) if span < 10_000 else (1,)))
    panel.xaxis.set_major_formatter(FuncFormatter(_number))
    panel.xaxis.set_minor_formatter(NullFormatter())


def _noisy(panel: Axes, curve: Curve, color: str, faint: bool, linestyle: str = "-") -> None:
    """The running median of a curve whose steps have different views, and the curve itself, faintly, if wanted."""
    if not curve:
        return
    steps, values = np.asarray(curve.steps), np.asarray(curve.values)
    reach = max(len(values) // _SMOOTHING, 1)
    smooth = [np.median(values[max(i - reach, 0) : i + reach + 1]) for i in range(len(values))]
    if faint:
        panel.plot(steps, values, color=color, alpha=0.2, linewidth=0.7)
    panel.plot(steps, smooth, color=color, linestyle=linestyle, linewidth=1.4)
