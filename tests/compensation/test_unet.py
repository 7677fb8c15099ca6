"""The U-Net: the paper's sizes, any image size, gradients."""

from __future__ import annotations

import pytest
import torch

from sundae_ns.compensation import UNet
from sundae_ns.compensation.head import SIZES


@pytest.mark.parametrize(("size", "mebibytes"), [("small", 7.2), ("regular", 30), ("large", 120)])
def test_paper_sizes(size: str, mebibytes: float) -> None:
    width, max_width = SIZES[size]
    net = UNet(3, 3, width, max_width=max_width)
    stored = 4 * sum(p.numel() for p in net.parameters()) / 2**20
    assert stored == pytest.approx(mebibytes, rel=0.04)


def test_widest_level() -> None:
    net = UNet(3, 3, 8, max_width=16)
    assert {p.shape[0] for p in net.encoder.parameters()} == {8, 16}
    assert net(torch.rand(1, 3, 20, 24)).shape == (1, 3, 20, 24)


@pytest.mark.parametrize("unshuffle", [1, 2, 4])
@pytest.mark.parametrize(("height", "width"), [(30, 30), (31, 47), (1, 1), (64, 5)])
def test_any_size(unshuffle: int, height: int, width: int) -> None:
    net = UNet(5, 3, 4, pixel_unshuffle=unshuffle)
    out = net(torch.rand(1, 5, height, width))
    assert out.shape == (1, 3, height, width)
    assert out.isfinite().all()


def test_padding_affects_the_edge_only() -> None:
    """An image cropped to an odd size keeps its values far from the crop."""
    net = UNet(3, 3, 8)
    image = torch.rand(1, 3, 128, 128)
    whole, cut = net(image), net(image[..., :117, :115])
    assert cut.shape[-2:] == (117, 115)
    assert torch.allclose(cut[..., :24, :24], whole[..., :24, :24], atol=1e-6)
    assert not torch.allclose(cut[..., -4:, -4:], whole[..., 113:117, 111:115], atol=1e-6)


def test_zero_start_is_exactly_zero() -> None:
    net = UNet(3, 3, 4, zero_init=True)
    assert torch.equal(net(torch.rand(1, 3, 32, 32)), torch.zeros(1, 3, 32, 32))


def test_gradcheck() -> None:
    net = UNet(2, 1, 2).double()
    image = torch.rand(1, 2, 9, 11, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(net, (image,), fast_mode=True)


def test_coarse_levels_reach_far() -> None:
    """The receptive field is larger than that of the finest level's own convolutions."""
    torch.manual_seed(1)
    net = UNet(1, 1, 8)
    image = torch.zeros(1, 1, 64, 64, requires_grad=True)
    (gradient,) = torch.autograd.grad(net(image)[0, 0, 32, 32], image)
    rows = gradient[0, 0].abs().sum(dim=1).nonzero().squeeze(1)
    assert int(rows.max() - rows.min()) > 40
