"""Detail of an image as weights of its pixels."""

from __future__ import annotations

import pytest
import torch

from sundae_ns.pruning.detail import pixel_detail


def test_edges_weigh_more_than_flat_areas_and_flat_areas_more_than_0() -> None:
    image = torch.zeros(64, 64, 3)
    image[:, 32:] = 1
    found = pixel_detail(image, 400)
    assert found.shape == (64, 64)
    assert float(found.mean()) == pytest.approx(1)
    assert found[:, 31:33].min() > 10 * found[:, :20].max()
    assert found.min() > 0


def test_more_cells_are_smaller() -> None:
    image = torch.zeros(64, 64, 3)
    image[:, 32:] = 1
    widths = [int((pixel_detail(image, cells)[0] > 1).sum()) for cells in (10, 100, 4096)]
    assert widths == sorted(widths, reverse=True)
    assert widths[0] > 2 * widths[-1]


@pytest.mark.parametrize("cells", [0.0, 1.0, 1e9])
@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 50, 3), (7, 3, 1)])
def test_any_image_and_number_of_cells_has_weights(cells: float, shape: tuple[int, int, int]) -> None:
    for image in (torch.rand(shape), torch.full(shape, 0.5), torch.full(shape, torch.nan)):
        found = pixel_detail(image, cells)
        assert found.isfinite().all()
        assert (found > 0).all()
        assert float(found.mean()) == pytest.approx(1, rel=1e-5)


def test_weights_do_not_depend_on_contrast() -> None:
    image = torch.rand(32, 32, 3)
    torch.testing.assert_close(pixel_detail(0.01 * image + 0.3, 50), pixel_detail(image, 50), rtol=1e-4, atol=1e-4)
