"""Viewer colours of features, depth and response stay in range for any input."""

import pytest
import torch

from sundae_ns.scene import frames


def test_empty_pixels_get_the_largest_depth():
    depth = torch.tensor([[[2.0], [0.0]], [[5.0], [1.0]]])
    alpha = torch.tensor([[[0.5], [0.0]], [[1.0], [0.1]]])
    assert frames.fill_depth(depth, alpha)[..., 0].tolist() == [[2.0, 5.0], [5.0, 1.0]]
    assert not frames.fill_depth(torch.zeros(2, 3, 1), torch.zeros(2, 3, 1)).any()


def features(n=2000):
    generator = torch.Generator().manual_seed(0)
    spread = torch.tensor([0.1, 3.0, 0.01, 1.0, 0.3])
    return torch.randn(n, 5, generator=generator) * spread + torch.arange(5.0)


def test_principal_components_are_sorted_by_variance():
    mean, basis, deviations = frames.principal_components(features())
    torch.testing.assert_close(mean, torch.arange(5.0), atol=0.2, rtol=0)
    assert basis.abs().argmax(dim=0).tolist() == [1, 3, 4]
    torch.testing.assert_close(basis.T @ basis, torch.eye(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(deviations, torch.tensor([3.0, 1.0, 0.3]), atol=0, rtol=0.1)
    for seed in range(8):  # signs are fixed
        values = torch.randn(50, 6, generator=torch.Generator().manual_seed(seed))
        assert (frames.principal_components(values)[1].sum(dim=0) > 0).all()


@pytest.mark.parametrize("width", [1, 2])
def test_fewer_channels_than_colours(width):
    mean, basis, deviations = frames.principal_components(features()[:, :width])
    assert basis.shape == (width, 3)
    assert not basis[:, width:].any()
    colors = frames.feature_colors(torch.randn(4, 6, width), mean, basis, deviations, torch.ones(4, 6, 1))
    assert colors.shape == (4, 6, 3)
    assert torch.isfinite(colors).all()
    # A missing direction shows mid-grey, not noise.
    torch.testing.assert_close(colors[..., width:], torch.full((4, 6, 3 - width), 0.5))


def test_colours_are_in_range_grey_at_the_mean_and_black_in_empty_pixels():
    values = features()
    parts = frames.principal_components(values)
    alpha = torch.ones(40, 50, 1)
    colors = frames.feature_colors(values.reshape(40, 50, 5), *parts, alpha)
    assert 0 <= colors.min()
    assert colors.max() <= 1
    # Three deviations fill the range: almost nothing is clipped, and all channels vary equally.
    assert ((colors > 0) & (colors < 1)).float().mean() > 0.99
    torch.testing.assert_close(colors.reshape(-1, 3).std(dim=0), torch.full((3,), 1 / 6), atol=0.01, rtol=0)
    grey = frames.feature_colors(parts[0].expand(2, 2, 5), *parts, torch.ones(2, 2, 1))
    torch.testing.assert_close(grey, torch.full((2, 2, 3), 0.5))
    assert not frames.feature_colors(torch.zeros(2, 2, 5), *parts, torch.zeros(2, 2, 1)).any()
    equal = torch.full((2, 3, 4), 0.3)
    colors = frames.feature_colors(equal, *frames.principal_components(equal.reshape(-1, 4)), torch.ones(2, 3, 1))
    assert ((colors >= 0) & (colors <= 1)).all(), "features of no variance have finite colours"


def test_response_values_are_ranks():
    response = torch.tensor([10.0, torch.nan, 0.1, 1e6, 0.0])
    values = frames.response_values(response)
    assert values.tolist() == [0.75, 0.0, 0.5, 1.0, 0.25]
    assert torch.equal(values, frames.response_values(response * 1e-7))
    assert torch.equal(values, frames.response_values(response.double()))  # the viewer needs float32
    assert frames.response_values(torch.full((3,), torch.nan)).tolist() == [0.0] * 3
