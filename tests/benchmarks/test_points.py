"""Images of points: projection, visibility, and degenerate input."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData
from torch import Tensor

from harness.points import (
    BACKGROUND,
    Projection,
    draw_points,
    points_sheet,
    project_along_axes,
    project_through_camera,
    response_histogram,
    write_points,
)
from sundae_ns.errors import DataError
from sundae_ns.storage.ply import read_point_cloud

RED, BLUE = torch.tensor([[255, 0, 0], [0, 0, 255]], dtype=torch.uint8)
K = torch.tensor([[100.0, 0.0, 50.0], [0.0, 100.0, 40.0], [0.0, 0.0, 1.0]])


def projection(*pixels_and_depths: tuple[float, float, float], width: int = 30, height: int = 20) -> Projection:
    rows = torch.tensor(pixels_and_depths, dtype=torch.float64).reshape(-1, 3)
    return Projection("", rows[:, :2], rows[:, 2], width, height)


def drawn(image: Any) -> Any:
    return (image != BACKGROUND).any(axis=2)


def test_projection_follows_the_camera_matrices() -> None:
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, -0.5, 2.0], [0.0, 0.0, -9.0]])
    turned = torch.tensor([[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 5.0], [0.0, 0.0, 0.0, 1.0]])
    for viewmat in (turned, turned[:3]):
        seen = project_through_camera(points, viewmat, K, 100, 80)
        expected = torch.tensor([[50.0, 40.0], [50 + 100 * 0.5 / 7, 40 + 100 * 1 / 7]], dtype=torch.float64)
        torch.testing.assert_close(seen.pixels[:2], expected, atol=1e-5, rtol=0)
        assert seen.depth.tolist() == [5.0, 7.0, -4.0]
    assert seen.pixels.isfinite().all()


def test_the_nearest_point_covers_the_others_in_any_order() -> None:
    far_and_near = ((10.5, 10.5, 5.0), (10.5, 10.5, 2.0))
    for places, colors in ((far_and_near, (BLUE, RED)), (far_and_near[::-1], (RED, BLUE))):
        image = draw_points(projection(*places), torch.stack(colors))
        assert image.shape == (20, 30, 3)
        assert image[10, 10].tolist() == [255, 0, 0]


def test_points_outside_and_behind_are_not_drawn() -> None:
    outside = [(-1.0, 5.0, 1.0), (30.0, 5.0, 1.0), (5.0, 20.0, 1.0), (5.0, 5.0, 0.0), (5.0, 5.0, -1.0)]
    outside += [(float("nan"), 5.0, 1.0), (float("inf"), 5.0, 1.0)]
    assert not drawn(draw_points(projection(*outside), RED.repeat(len(outside), 1))).any()
    corners = [(0.0, 0.0, 1.0), (29.9, 0.0, 1.0), (0.0, 19.9, 1.0), (29.9, 19.9, 1.0)]
    image = drawn(draw_points(projection(*corners), RED.repeat(4, 1)))
    assert image[0, 0]
    assert image[0, -1]
    assert image[-1, 0]
    assert image[-1, -1]


def test_a_mask_leaves_points_out_and_fewer_points_are_larger() -> None:
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(20_000, 2, generator=generator, dtype=torch.float64) * 400
    seen = Projection("", places, torch.ones(len(places)), 400, 400)
    colors = RED.repeat(len(places), 1)
    only = torch.zeros(len(places), dtype=torch.bool)
    only[7] = True
    square = drawn(draw_points(seen, colors, only))
    rows, columns = np.nonzero(square)
    assert square.sum() == (400 // 90) ** 2
    assert abs(columns.mean() - places[7, 0]) < 3
    assert abs(rows.mean() - places[7, 1]) < 3
    assert only.sum() == 1
    # Many points are drawn so small that most of them are visible.
    assert 0.3 < drawn(draw_points(seen, colors)).mean() < 0.6


def test_projections_along_the_axes_show_the_middle_at_one_scale() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(2000, 3, generator=generator) * torch.tensor([4.0, 2.0, 1.0]) + 100.0
    points[:40] *= 1e6  # floaters
    above, front, side = project_along_axes(points, side=300)
    kept = points[40:].double()
    assert above.width == 300
    assert above.height == pytest.approx(220, abs=6)
    across = above.pixels[40:, 0]
    assert torch.equal(across.argsort(), kept[:, 0].argsort())
    # The second axis points up in the image, so a higher point has a smaller row.
    assert torch.equal(above.pixels[40:, 1].argsort(descending=True), kept[:, 1].argsort())
    assert torch.equal(above.depth[40:].argsort(), kept[:, 2].argsort(descending=True))
    assert torch.equal(front.pixels[40:, 1].argsort(descending=True), kept[:, 2].argsort())
    assert torch.equal(side.pixels[40:, 0].argsort(), kept[:, 1].argsort())
    spread = [float(seen.pixels[40:, 0].max() - seen.pixels[40:, 0].min()) for seen in (above, side)]
    assert spread[0] / spread[1] == pytest.approx(2, rel=0.02)
    inside = ((above.pixels >= 0) & (above.pixels < torch.tensor([300, above.height]))).all(dim=1)
    assert inside[40:].double().mean() > 0.95
    assert not inside[:40].any()


@pytest.mark.parametrize("points", [torch.zeros(1, 3), torch.ones(5, 3), torch.tensor([[0.0, 0, 0], [0, 0, 1e-30]])])
def test_degenerate_clouds_are_drawn(points: Tensor) -> None:
    for seen in project_along_axes(points, side=100):
        assert drawn(draw_points(seen, RED.repeat(len(points), 1))).any()


def test_a_sheet_has_a_panel_for_each_projection_and_set() -> None:
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    everything, nothing = torch.ones(50, dtype=torch.bool), torch.zeros(50, dtype=torch.bool)
    projections, colors = project_along_axes(points, side=100), RED.repeat(50, 1)
    sheet = points_sheet(projections, colors, {"all": everything, "none": nothing}, title="a title")
    red = (np.asarray(sheet) == [255, 0, 0]).all(axis=2)
    half = sheet.width // 2
    assert red[:, :half].any()
    assert not red[:, half:].any()
    single = points_sheet(projections[:1], colors, {"all": everything})
    assert single.height < sheet.height
    for given in (([], {"all": everything}), (projections, {})):
        with pytest.raises(DataError, match="nothing to draw"):
            points_sheet(given[0], colors, given[1])


@pytest.fixture
def drawings(monkeypatch: pytest.MonkeyPatch) -> Callable[[], Any]:
    """The last figure that was drawn."""
    import harness.points as module

    kept: list[Any] = []
    original = module._rendered
    monkeypatch.setattr(module, "_rendered", lambda figure: kept.append(figure) or original(figure))
    return lambda: kept[-1]


def test_a_histogram_counts_the_finite_positive_responses(drawings: Callable[[], Any]) -> None:
    generator = torch.Generator().manual_seed(0)
    magnitude = torch.cat([10 ** torch.randn(500, generator=generator, dtype=torch.float64), torch.zeros(3)])
    magnitude[:7] = torch.nan
    response_histogram(magnitude, thresholds={"0.1": (0.5, 2.0), "0.5": (None, 0.0)})
    (panel,) = drawings().axes
    assert sum(bar.get_height() for bar in panel.patches) == 493
    assert panel.get_xscale() == "log"
    assert "503" in panel.get_title()
    assert "7 without neighbours, 3 with response 0" in panel.get_title()
    assert sorted(float(line.get_xdata()[0]) for line in panel.lines) == [0.5, 2.0]


@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")  # matplotlib's, at the axis' end
@pytest.mark.parametrize(
    "values", [[], [0.0], [float("nan")] * 3, [float("inf"), 1.0], [2.0] * 4, [1e-300, 1e300], [5e-324]]
)
def test_any_responses_have_a_histogram(values: list[float]) -> None:
    magnitude = torch.tensor(values, dtype=torch.float64)
    assert response_histogram(magnitude, thresholds={}).width > 500


def test_points_come_back_with_their_colours_and_responses(tmp_path: Path) -> None:
    path, points, colors = tmp_path / "a.ply", torch.rand(2, 3), torch.stack([RED, BLUE])
    write_points(path, points, colors, torch.tensor([0.25, -1.0], dtype=torch.float64))
    found = read_point_cloud(path)
    assert torch.equal(found[0], points)
    assert torch.equal(found[1], colors)
    assert PlyData.read(str(path))["vertex"]["response"].tolist() == [0.25, -1.0]
    write_points(path, points[:0], colors[:0], points[:0, 0])
    assert read_point_cloud(path)[0].shape == (0, 3)
