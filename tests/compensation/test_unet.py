"""The U-Net: the paper's sizes, any picture size, gradients."""

from __future__ import annotations

import pytest
import torch

from sundae_ns.compensation import UNet
from sundae_ns.compensation.head import WIDTHS


@pytest.mark.parametrize(("size", "mebibytes"), [("small", 7.2), ("regular", 30), ("large", 120)])
def test_paper_sizes(size: str, mebibytes: float) -> None:
    net = UNet(3, 3, WIDTHS[size])
    stored = 4 * sum(p.numel() for p in net.parameters()) / 2**20
    assert stored == pytest.approx(mebibytes, rel=0.04)


@pytest.mark.parametrize("unshuffle", [1, 2, 4])
@pytest.mark.parametrize(("height", "width"), [(30, 30), (31, 47), (1, 1), (64, 5)])
def test_any_size(unshuffle: int, height: int, width: int) -> None:
    net = UNet(5, 3, 4, pixel_unshuffle=unshuffle)
    out = net(torch.rand(1, 5, height, width))
    assert out.shape == (1, 3, height, width)
    assert out.isfinite().all()


def test_padding_does_not_change_a_picture_that_needs_none() -> None:
    net = UNet(3, 3, 4, pixel_unshuffle=2)
    picture = torch.rand(1, 3, 32, 32)
    assert torch.equal(net(picture), net(picture.clone()))
    # A constant picture has nothing at its edge that padding by the edge could change.
    constant = torch.full((1, 3, 40, 40), 0.3)
    inner = net(constant)[..., 16:24, 16:24]
    odd = net(constant[..., :37, :35])
    assert odd.shape[-2:] == (37, 35)
    assert torch.allclose(odd[..., 16:20, 16:20], inner[..., :4, :4], atol=1e-5)


def test_zero_start_is_exactly_zero() -> None:
    net = UNet(3, 3, 4, zero_init=True)
    assert torch.equal(net(torch.rand(1, 3, 32, 32)), torch.zeros(1, 3, 32, 32))


def test_gradcheck() -> None:
    net = UNet(2, 1, 2).double()
    picture = torch.rand(1, 2, 9, 11, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(net, (picture,), fast_mode=True)


def test_coarse_levels_reach_far() -> None:
    """A change in one corner reaches pixels further away than the finest level's own convolutions could see."""
    torch.manual_seed(1)
    net = UNet(1, 1, 8)
    picture = torch.zeros(1, 1, 64, 64, requires_grad=True)
    (gradient,) = torch.autograd.grad(net(picture)[0, 0, 32, 32], picture)
    rows = gradient[0, 0].abs().sum(dim=1).nonzero().squeeze(1)
    assert int(rows.max() - rows.min()) > 40
