"""Plots of a report. Each function draws its runs and writes one file, without matplotlib's global state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from sundae_ns.evaluation.measured import HEAD_ON, MEGABYTE, Configuration, Measured

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from sundae_ns.evaluation.count_curve import CountCurve
    from sundae_ns.evaluation.curves import Curve, Curves

Cost = Literal["size", "time", "primitives"]

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Six colours that people with colour-vision deficiency can tell apart (Okabe and Ito, "Color Universal Design")."""
MOST_SERIES = len(PALETTE)
"""Most runs in a plot whose lines only their colour tells apart."""
_GRAY = "0.35"
_GRID = {"alpha": 0.3, "linewidth": 0.6}
_SMOOTHING = 30
"""The window of a running median reaches 1/30 of the run to both sides."""
_FAINT_RUNS = 2
"""Most runs whose values at single steps are drawn behind their medians; more would hide each other."""
_MARKERS = "os^DvP"
"""Markers of the first, second ... six runs: colours repeat after them."""
_COSTS: Mapping[Cost, tuple[Callable[[Measured, Configuration], float | None], str]] = {
    "size": (lambda run, way: way.bytes / MEGABYTE, "size, MB (smaller is better)"),
    "time": (lambda run, way: way.ms, "time per frame, ms (smaller is better)"),
    "primitives": (lambda run, way: run.primitives, "number of primitives (smaller is better)"),
}
_METRICS = (("psnr", "PSNR, dB (higher is better)"), ("ssim", "SSIM (higher is better)"))


def colors_of(labels: Sequence[str]) -> dict[str, str]:
    """The colour of each label, the same in all plots of a report. Colours repeat after :data:`MOST_SERIES` labels."""
    return {label: PALETTE[i % MOST_SERIES] for i, label in enumerate(labels)}


def plot_quality(file: Path | BinaryIO, runs: Sequence[Measured], cost: Cost, colors: Mapping[str, str]) -> bool:
    """PSNR and SSIM of the runs of a scene against a cost; a line connects a field with its head and without.

    Runs without this cost are left out. Returns whether there was a point to plot; otherwise no file is written.
    """
    value, cost_label = _COSTS[cost]
    places = [(run, way, x) for run in runs for way in run.configurations if (x := value(run, way)) is not None]
    metrics = [metric for metric in _METRICS if any(way.mean(metric[0]) is not None for _, way, _ in places)]
    if not metrics:
        return False
    markers = {run.label: _MARKERS[i // MOST_SERIES % len(_MARKERS)] for i, run in enumerate(runs)}
    figure, panels = _figure(1, len(metrics), width=5.4, height=4.2)
    for panel, (metric, metric_label) in zip(panels[0], metrics, strict=True):
        for run in runs:
            color = colors[run.label]
            own = [(x, y, way) for other, way, x in places if other is run and (y := way.mean(metric)) is not None]
            panel.plot([x for x, _, _ in own], [y for _, y, _ in own], color=color, linewidth=1, alpha=0.6)
            for x, y, way in own:
                face = color if way.name == HEAD_ON else "white"
                panel.scatter(x, y, s=48, marker=markers[run.label], zorder=3, facecolor=face, edgecolor=color)
        _cost_axis(panel, [x for _, _, x in places])
        panel.set_xlabel(cost_label)
        panel.set_ylabel(metric_label)
    handles = [_key(label, color=colors[label], marker=marker, linestyle="none") for label, marker in markers.items()]
    if any(run.has_head for run in runs):
        for text, face in (("filled: with the head", _GRAY), ("open: without the head", "white")):
            handles.append(_key(text, color=_GRAY, marker="o", markerfacecolor=face, linestyle="none"))
    _save(figure, file, handles, f"{runs[0].scene}: means over the test views")
    return True


def plot_counts(
    file: Path | BinaryIO, curve: CountCurve, *, title: str = "", form: Literal["png", "svg"] = "png"
) -> None:
    """Expected PSNR and SSIM against the number of primitives, with errors, and the number that was chosen."""
    figure, panels = _figure(1, 2, width=5.4, height=3.8)
    points = [point for point in curve.points if point.psnr_loss is not None and point.ssim_loss is not None]
    counts = [point.count for point in points]
    values = ([point.psnr for point in points], [point.ssim for point in points])
    errors = ([point.psnr_error for point in points], [point.ssim_error for point in points])
    for panel, (_, label), value, error in zip(panels.flat, _METRICS, values, errors, strict=True):
        panel.errorbar(counts, value, yerr=error, color=PALETTE[0], marker="o", markersize=5, capsize=3, linewidth=1.3)
        panel.axvline(curve.chosen, color=PALETTE[1], linestyle="--", linewidth=1.3)
        panel.set_ylabel(label, fontsize=9)
        panel.set_xlabel("number of primitives (smaller is better)")
        _cost_axis(panel, [*counts, curve.chosen])
    keys = [
        _key("expected; bars: standard error of the loss over the views", color=PALETTE[0], marker="o"),
        _key(f"chosen: {curve.chosen:,} of {curve.full:,}", color=PALETTE[1], linestyle="--"),
    ]
    _save(figure, file, keys, title, form)


def plot_views(file: Path | BinaryIO, runs: Sequence[Measured], colors: Mapping[str, str]) -> None:
    """PSNR of every test view of at most :data:`MOST_SERIES` runs of a scene; dashed lines are without the head."""
    count = max(len(run.full.views) for run in runs)
    figure, panels = _figure(1, 1, width=min(7 + 0.12 * count, 16), height=3.8)
    panel = panels[0, 0]
    for run in runs:
        for configuration in run.configurations:
            solid = {"linestyle": "-", "marker": "o", "markersize": 4, "linewidth": 1.3}
            look = solid if configuration is run.full else {"linestyle": "--", "linewidth": 1, "alpha": 0.6}
            panel.plot([view.psnr for view in configuration.views], color=colors[run.label], **look)
    panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    panel.set_xlabel("test view, in the order of the capture")
    panel.set_ylabel("PSNR, dB (higher is better)")
    handles = [_key(run.label, color=colors[run.label], marker="o", markersize=4) for run in runs]
    if any(run.has_head for run in runs):
        handles.append(_key("same field, head off", color=_GRAY, linestyle="--"))
    _save(figure, file, handles, f"{runs[0].scene}: PSNR of each test view")


def plot_curves(file: Path | BinaryIO, curves: Mapping[str, Curves], colors: Mapping[str, str], *, title: str) -> None:
    """Loss, number of primitives, PSNR of training views, and peak memory over training, by label.

    There are at least one and at most :data:`MOST_SERIES` runs in ``curves``.
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
        line = {"color": colors[label], "linewidth": 1.3}
        _noisy(loss, run.loss, colors[label], faint)
        # Steps, not slopes: a prune is instantaneous.
        count.plot(run.primitives.steps, run.primitives.values, drawstyle="steps-post", **line)
        _noisy(psnr, run.psnr, colors[label], faint)
        if run.psnr_base.values != run.psnr.values:
            without_head = True
            _noisy(psnr, run.psnr_base, colors[label], False, linestyle="--")
        if any(run.memory.values):
            memory.plot(run.memory.steps, run.memory.values, **line)
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
    handles = [_key(label, color=colors[label]) for label in curves]
    if without_head:
        handles.append(_key("PSNR without the head", color=_GRAY, linestyle="--"))
    _save(figure, file, handles, f"{title} (loss and PSNR are running medians; each step has another view)")


def _figure(rows: int, columns: int, *, width: float, height: float) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(width * columns, height * rows + 0.6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False)
    for panel in panels.flat:
        panel.grid(**_GRID)
        panel.spines[["top", "right"]].set_visible(False)
    return figure, panels


def _key(label: str, **look: Any) -> Line2D:
    return Line2D([], [], label=label, **look)


def _save(figure: Figure, file: Path | BinaryIO, keys: Sequence[Line2D], title: str, form: str = "png") -> None:
    # The legend is below the panels, where it hides no data.
    figure.legend(handles=keys, loc="outside lower center", ncols=min(len(keys), 3), fontsize=8, frameon=False)
    if title:
        figure.suptitle(title, fontsize=11)
    figure.savefig(file, format=form)


def _number(value: float, _: object = None) -> str:
    """A short tick label, such as ``350k`` or ``1.5M``."""
    for unit, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= unit:
            return f"{value / unit:g}{letter}"
    return f"{value:g}"


def _cost_axis(panel: Axes, values: Sequence[float]) -> None:
    """Choose a linear axis for values within a factor of 4, else a logarithmic one, with readable ticks."""
    panel.margins(0.2)
    span = max(values) / min(values) if min(values) > 0 else 0
    if span < 4:
        panel.xaxis.set_major_locator(MaxNLocator(6))
    else:
        panel.set_xscale("log")
        panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if span < 100 else (1, 3) if span < 10_000 else (1,)))
        panel.xaxis.set_minor_formatter(NullFormatter())
    panel.xaxis.set_major_formatter(FuncFormatter(_number))


def _noisy(panel: Axes, curve: Curve, color: str, faint: bool, linestyle: str = "-") -> None:
    """The running median of a curve whose steps have different views, and the curve itself, faintly, if wanted."""
    if not curve.steps:
        return
    steps, values = np.asarray(curve.steps), np.asarray(curve.values)
    reach = max(len(values) // _SMOOTHING, 1)
    smooth = [np.median(values[max(i - reach, 0) : i + reach + 1]) for i in range(len(values))]
    if faint:
        panel.plot(steps, values, color=color, alpha=0.2, linewidth=0.7)
    panel.plot(steps, smooth, color=color, linestyle=linestyle, linewidth=1.4)
