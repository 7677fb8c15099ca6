"""The plots of ``sundae report``; whole reports are tested in integration/."""

from __future__ import annotations

from sundae_ns.cli.report import _plot
from sundae_ns.evaluation import HEAD_OFF, Configuration, Measured, ViewQuality
from sundae_ns.evaluation.curves import Curve, Curves


def measured(label: str) -> Measured:
    views = (ViewQuality(25.0, 0.8), ViewQuality(26.0, 0.9))
    return Measured(
        label=label,
        source=label,
        scene="garden",
        method="splatfacto",
        variant="",
        keep_ratio=1.0,
        seed=42,
        steps=30_000,
        primitives=4000,
        bytes_primitives=1_000_000,
        bytes_head=0,
        resolution="40x30",
        configurations=(Configuration(HEAD_OFF, None, 1_000_000, views),),
    )


def test_plots_of_lines_have_at_most_six_runs() -> None:
    runs = [measured(f"run {i}") for i in range(8)]
    curve = Curve((0, 1), (2.0, 1.0))
    curves = {run.label: Curves(loss=curve) for run in runs[6:]}
    plots, files = _plot({"garden": runs}, curves, {})
    names = [name for _, name in plots["garden"]]
    # Nothing was timed.
    assert names[:2] == ["quality-size.png", "quality-primitives.png"]
    assert names[2:] == ["views.png", "views-from-7.png", "curves-from-7.png"]
    assert set(files) == set(names)
    assert all(content.startswith(b"\x89PNG") for content in files.values())


def test_each_scene_has_its_own_plots() -> None:
    scenes = {"garden": [measured("a")], "fox": [measured("b")]}
    plots, _ = _plot(scenes, {}, {})
    assert [name for _, name in plots["garden"]] == ["quality-size-1.png", "quality-primitives-1.png", "views-1.png"]
    assert [name for _, name in plots["fox"]] == ["quality-size-2.png", "quality-primitives-2.png", "views-2.png"]
