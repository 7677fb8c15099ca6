"""Signals, responses, scores, and the detail of images as weights of their pixels."""

import itertools

import pytest
import torch
from prunes import PAPER, gaussians

from sundae_ns.core.gaussians import rgb_to_sh
from sundae_ns.pruning.rule import PruneRule
from sundae_ns.pruning.scores import attribute_signal, pixel_detail, response, score


def test_scores_by_hand():
    params, weights = gaussians(40), torch.arange(40.0).index_fill(0, torch.tensor([7]), torch.nan)
    expected = torch.arange(40.0).double().index_fill(0, torch.tensor([7]), 0)  # NaN counts as 0
    assert torch.equal(score(params, PruneRule(), None, weights), expected)
    torch.testing.assert_close(score(params, PAPER, None, None), response(params, PAPER).sqrt(), equal_nan=True)
    opacity = score(params, PruneRule(score=lambda given: given["opacities"].sigmoid().flatten()), None, None)
    torch.testing.assert_close(opacity, params["opacities"].sigmoid().flatten().double())


def test_attribute_response_finds_the_colour_edge():
    n = 400
    params = gaussians(n)
    grid = torch.arange(20.0)
    params["means"] = torch.cartesian_prod(grid, grid, torch.zeros(1))
    params["features_dc"] = rgb_to_sh(torch.where(params["means"][:, 0] < 10, 0.2, 0.8)[:, None].expand(-1, 3)).clone()
    params["scales"] = torch.zeros(n, 3)
    params["opacities"] = torch.zeros(n, 1)
    magnitude = response(params, PruneRule(num_neighbors=8, edges="centres"))
    edge = (params["means"][:, 0] - 9.5).abs() < 1
    assert magnitude[edge].min() > 10 * magnitude[~edge].max()


def test_signals_have_no_unit_and_no_dominating_group():
    params = gaussians()
    signal = attribute_signal(params)
    assert signal.shape == (60, 10)
    for group in (slice(0, 3), slice(3, 6), slice(6, 7), slice(7, 10)):
        assert signal[:, group].norm(dim=1).median().item() == pytest.approx(1.0, rel=1e-5)
    scaled = {**params, "means": 1000 * params["means"] + 5, "scales": params["scales"] + 3}
    torch.testing.assert_close(attribute_signal(scaled), signal, rtol=1e-4, atol=1e-4)


def test_constant_and_almost_constant_attributes_are_finite():
    params = gaussians()
    params["scales"] = torch.full((60, 3), 2.0)
    params["opacities"] = torch.zeros(60, 1)
    params["opacities"][0] = 3.0
    signal = attribute_signal(params)
    assert signal.isfinite().all()
    assert (signal[:, 7:] == 0).all()
    assert signal[0, 6] > 0
    assert (signal[1:, 6] == 0).all()


@pytest.mark.parametrize(("cells", "half"), [(3, 9), (20, 4), (1500, 1)])
def test_detail_is_the_deviation_within_the_window_of_a_cell(cells, half):
    """By windows one by one, also at the edges; for 3 cells the window is as high as the image."""
    image = torch.rand(19, 76, 2, generator=torch.Generator().manual_seed(0))
    variance = torch.empty(19, 76, dtype=torch.float64)
    for y, x in itertools.product(range(19), range(76)):
        window = image[max(y - half, 0) : y + half + 1, max(x - half, 0) : x + half + 1].double()
        variance[y, x] = window.var(dim=(0, 1), correction=0).sum()
    expected = (variance + variance.mean() / 16).sqrt()
    torch.testing.assert_close(pixel_detail(image, cells).double(), expected / expected.mean(), rtol=1e-6, atol=0)


@pytest.mark.parametrize("cells", [0.0, 1.0, 1e9])
@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 50, 3), (7, 3, 1)])
def test_any_image_and_number_of_cells_has_weights(cells, shape):
    for image in (torch.rand(shape), torch.full(shape, 0.5), torch.full(shape, torch.nan)):
        found = pixel_detail(image, cells)
        assert found.isfinite().all()
        assert (found > 0).all()
        assert float(found.mean()) == pytest.approx(1, rel=1e-5)
