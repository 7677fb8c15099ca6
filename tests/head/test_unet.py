"""The U-Net: the paper's size, any image size, gradients."""

import pytest
import torch

from sundae_ns.head.head import SIZES
from sundae_ns.head.unet import UNet


def test_the_papers_size_and_a_limited_width():
    net = UNet(3, 3, SIZES["regular"][0])
    assert 4 * sum(p.numel() for p in net.parameters()) / 2**20 == pytest.approx(30, rel=0.04)
    net = UNet(3, 3, 8, max_width=16)
    assert {p.shape[0] for p in net.encoder.parameters()} == {8, 16}
    assert net(torch.rand(1, 3, 20, 24)).shape == (1, 3, 20, 24)


@pytest.mark.parametrize("unshuffle", [1, 2, 4])
@pytest.mark.parametrize(("height", "width"), [(30, 30), (31, 47), (1, 1), (64, 5)])
def test_any_size(unshuffle, height, width):
    image = torch.rand(1, 5, height, width)
    out = UNet(5, 3, 4, pixel_unshuffle=unshuffle)(image)
    assert out.shape == (1, 3, height, width)
    assert out.isfinite().all()
    zero = UNet(5, 3, 4, pixel_unshuffle=unshuffle, zero_init=True)
    assert torch.equal(zero(image), torch.zeros_like(out))


def test_padding_affects_the_edge_only():
    """An image cropped to an odd size keeps its values far from the crop."""
    net = UNet(3, 3, 8)
    image = torch.rand(1, 3, 128, 128)
    full, cropped = net(image), net(image[..., :117, :115])
    assert cropped.shape[-2:] == (117, 115)
    assert torch.allclose(cropped[..., :24, :24], full[..., :24, :24], atol=1e-6)
    assert not torch.allclose(cropped[..., -4:, -4:], full[..., 113:117, 111:115], atol=1e-6)


def test_gradcheck():
    net = UNet(2, 1, 2).double()
    image = torch.rand(1, 2, 9, 11, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(net, (image,), fast_mode=True)


def test_coarse_levels_reach_far():
    """The receptive field is larger than that of the finest level's own convolutions."""
    torch.manual_seed(1)
    image = torch.zeros(1, 1, 64, 64, requires_grad=True)
    (gradient,) = torch.autograd.grad(UNet(1, 1, 8)(image)[0, 0, 32, 32], image)
    rows = gradient[0, 0].abs().sum(dim=1).nonzero().squeeze(1)
    assert int(rows.max() - rows.min()) > 40
