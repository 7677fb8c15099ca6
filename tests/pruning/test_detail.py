"""Detail of a picture as a weight of its pixels."""

from __future__ import annotations

import pytest
import torch

from sundae_ns.errors import DataError
from sundae_ns.pruning import pixel_detail


def test_edges_count_more_than_walls_and_walls_something() -> None:
    picture = torch.zeros(64, 64, 3)
    picture[:, 32:] = 1
    found = pixel_detail(picture, 400)
    assert found.shape == (64, 64)
    assert float(found.mean()) == pytest.approx(1)
    assert found[:, 31:33].min() > 10 * found[:, :20].max()
    assert found.min() > 0


def test_a_larger_budget_looks_at_smaller_cells() -> None:
    picture = torch.zeros(64, 64, 3)
    picture[:, 32:] = 1
    widths = [int((pixel_detail(picture, cells)[0] > 1).sum()) for cells in (10, 100, 4096)]
    assert widths == sorted(widths, reverse=True)
    assert widths[0] > 2 * widths[-1]


@pytest.mark.parametrize("cells", [0.0, 1.0, 1e9])
@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 50, 3), (7, 3, 1)])
def test_any_picture_and_budget_has_weights(cells: float, shape: tuple[int, int, int]) -> None:
    for picture in (torch.rand(shape), torch.full(shape, 0.5), torch.full(shape, torch.nan)):
        found = pixel_detail(picture, cells)
        assert found.isfinite().all()
        assert (found > 0).all()
        assert float(found.mean()) == pytest.approx(1, rel=1e-5)


def test_contrast_has_no_unit() -> None:
    picture = torch.rand(32, 32, 3)
    torch.testing.assert_close(pixel_detail(0.01 * picture + 0.3, 50), pixel_detail(picture, 50), rtol=1e-4, atol=1e-4)


def test_an_odd_shape_is_refused() -> None:
    with pytest.raises(DataError, match=r"\[4, 4\]"):
        pixel_detail(torch.zeros(4, 4), 1)
