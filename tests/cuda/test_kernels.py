"""Kernels of Adam, loss and plane sweep: the CUDA source, compiled for the CPU, beside PyTorch's operations.

A block has one thread on the CPU: only the tests on a GPU cover shared memory and the sum over threads.
"""

import pytest
import torch
from pytorch_msssim import SSIM

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import BackendError
from sundae_ns.cuda import adam, kernels, loss, sweep
from sundae_ns.cuda.kernels import kernels_where_possible
from sundae_ns.cuda.loss import fused_loss
from sundae_ns.train import plane_sweep
from sundae_ns.train.state import Photo
from sundae_ns.train.step import image_losses


@pytest.fixture(autouse=True)
def on_cpu(request, load_on_cpu, monkeypatch):
    if not request.node.get_closest_marker("gpu"):
        for module in (adam, loss, sweep):
            monkeypatch.setattr(module, "load_kernels", load_on_cpu)


@pytest.mark.parametrize("module", [adam, loss, sweep])
def test_it_compiles_for_gpus(module, compile_for_gpu):
    for architecture in ("sm_75", "sm_90"):
        assert compile_for_gpu(f"{module.__name__.split('.')[-1]}.cu", architecture, module.OPTIONS)


def test_missing_kernels_are_reported_once(caplog):
    def refuse(_):
        raise BackendError("NVRTC fails: update torch")

    assert [kernels_where_possible(refuse, torch.device("cuda"), "it is slow") for _ in range(2)] == [None, None]
    assert caplog.text.count("it is slow, on cuda: NVRTC fails") == 1


def test_a_number_beyond_32_bits_is_refused():
    with pytest.raises(BackendError, match="got 2,147,483,648"):
        kernels._as_c(2**31, torch.device("cpu"))


def test_adam_follows_torch():
    n, betas = 1000, (0.9, 0.999)
    value = torch.randn(n)
    exact = torch.nn.Parameter(value.double())
    optimizer = torch.optim.Adam([exact], lr=1.0, betas=betas, eps=1e-15)
    mean, square, step = torch.zeros(n), torch.zeros(n), torch.zeros(())
    scales = 10 ** (torch.rand(n) * 12 - 10)
    scales[:10] = 0
    for count in range(1, 30):
        gradient, rate = torch.randn(n) * scales, 0.01 / count
        step += 1
        adam.adam(adam.Update(value, gradient, mean, square, step), torch.tensor(rate), None, betas=betas, eps=1e-15)
        optimizer.param_groups[0]["lr"], exact.grad = rate, gradient.double()
        optimizer.step()
    torch.testing.assert_close(value.double(), exact.detach(), rtol=0, atol=2e-6)
    state = optimizer.state[exact]
    torch.testing.assert_close(mean.double(), state["exp_avg"], rtol=1e-3, atol=1e-12)
    torch.testing.assert_close(square.double(), state["exp_avg_sq"], rtol=1e-4, atol=1e-20)


def test_a_skipped_step_of_adam_changes_nothing():
    tensors = [torch.ones(1000) for _ in range(4)]
    before = [value.clone() for value in tensors]
    ones, rate = torch.ones(()), torch.tensor(0.1)
    update = adam.Update(tensors[0], tensors[1], tensors[2], tensors[3], ones)
    adam.adam(update, rate, ones, betas=(0.9, 0.999), eps=1e-8)
    assert all(torch.equal(value, old) for value, old in zip(tensors, before, strict=True))
    adam.adam(update, rate, torch.zeros(()), betas=(0.9, 0.999), eps=1e-8)
    assert (tensors[0] != before[0]).all()


SIZES = [(11, 11), (11, 300), (12, 43), (26, 42), (27, 43), (64, 97)]


def images(height, width, seed=0):
    """An image near its target, and the target, with edges and flat parts."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=generator).mul(3).round() / 3
    target[: height // 3] = 0.25
    return (target + 0.1 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1), target


def exact_loss(image, target, weight):
    image, ssim = image.double().requires_grad_(), SSIM(data_range=1.0, channel=3)
    ssim.win = ssim.win.to(image)  # moving the module leaves its window where it was
    value = image_losses(image, None, target.double(), ssim, weight)[0]
    (gradient,) = torch.autograd.grad(value, image)
    return value.detach(), gradient


def our_loss(image, target, weight):
    image = image.clone().requires_grad_()
    value, _ = fused_loss(image, target, weight)
    (gradient,) = torch.autograd.grad(value, image)
    return value.detach(), gradient


@pytest.mark.parametrize(("size", "scale"), [*((size, 1.0) for size in SIZES), *(((30, 47), 10.0**k) for k in (-4, 4))])
@pytest.mark.parametrize("weight", [0.2, 1.0])
def test_the_loss_and_its_gradient(size, scale, weight):
    pair = [scale * value for value in images(*size)]
    value, gradient = our_loss(*pair, weight)
    expected, expected_gradient = exact_loss(*pair, weight)
    assert value.item() == pytest.approx(expected.item(), rel=1e-4, abs=2e-6)
    bound = 2e-4 if scale == 1 else 2e-3
    assert (gradient - expected_gradient).abs().max() < bound * expected_gradient.abs().max()


@pytest.mark.parametrize("size", SIZES[::2])
def test_base_colours_strides_and_a_weight_of_its_own_for_l1(size):
    image, target = images(*size)
    base = images(*size, seed=1)[0]
    expected, expected_gradient = our_loss(image, target, 0.2)
    leaves = [value.permute(1, 0, 2).contiguous().permute(1, 0, 2).requires_grad_() for value in (image, base)]
    value, base_loss = fused_loss(leaves[0], target, 0.2, leaves[1])
    assert not value._is_view()
    assert torch.equal(value, expected)
    assert base_loss.item() == pytest.approx((base - target).abs().mean().item(), rel=1e-5)
    grad_image, grad_base = torch.autograd.grad(2 * value + 0.3 * base_loss, leaves)
    torch.testing.assert_close(grad_image, 2 * expected_gradient)
    torch.testing.assert_close(grad_base, 0.3 * (base - target).sign() / base.numel())
    alone = fused_loss(image, target, 0.2, l1_weight=0.0)[0]
    torch.testing.assert_close(expected - alone, 0.8 * (image - target).abs().mean())


def test_nan_propagates():
    image, target = images(30, 47)
    image[15, 20, 1] = torch.nan
    value, gradient = our_loss(image, target, 0.2)
    assert value.isnan()
    assert gradient[15, 20, 1].isnan()
    assert gradient[:4].isfinite().all()
    base = target.clone()
    base[20, 25, 2] = torch.nan
    value, base_loss = fused_loss(target, target, 0.2, base.requires_grad_())
    assert value.isfinite()
    assert base_loss.isnan()
    assert torch.autograd.grad(base_loss, base)[0].isnan().sum() == 1


def test_small_losses_are_accurate():
    """They are not computed as differences of two large sums."""
    image, target = images(64, 97)
    near = target + 1e-3 * (image - target)
    expected, _ = exact_loss(near, target, 1.0)
    assert 0 < expected < 1e-4
    assert our_loss(near, target, 1.0)[0].item() == pytest.approx(expected.item(), rel=0.02)
    for same in (target, torch.zeros(20, 20, 3), torch.ones(20, 20, 3)):
        value, gradient = our_loss(same, same.clone(), 0.5)
        assert abs(value) < 1e-6
        assert gradient.abs().max() < 1e-5


def test_no_second_gradient_and_none_for_the_target():
    image, target = (value.requires_grad_() for value in images(20, 30))
    (gradient,) = torch.autograd.grad(fused_loss(image, target, 0.2)[0].square(), image, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()
    assert not fused_loss(image.detach(), target, 0.2)[0].requires_grad


@pytest.mark.gpu
@pytest.mark.parametrize("size", [*SIZES, (1061, 1893)])
def test_the_loss_on_a_gpu(size):
    image, target = (value.cuda().requires_grad_(n == 0) for n, value in enumerate(images(*size)))
    base = images(*size, seed=1)[0].cuda().requires_grad_()
    ssim = SSIM(data_range=1.0, channel=3)
    value, base_loss = image_losses(image, base, target, ssim, 0.2)
    assert "_Loss" in type(value.grad_fn).__name__
    gradient, grad_base = torch.autograd.grad(value + base_loss, (image, base))
    expected, expected_gradient = exact_loss(image.detach(), target, 0.2)
    assert value.item() == pytest.approx(expected.item(), abs=2e-6)
    assert (gradient - expected_gradient).abs().max() < 2e-4 * expected_gradient.abs().max()
    assert base_loss.item() == pytest.approx((base - target).abs().mean().item(), rel=1e-5)
    torch.testing.assert_close(grad_base, (base - target).sign() / base.numel())
    alone = image_losses(image, None, target, ssim, 0.2)[0]
    assert torch.equal(alone, value)
    assert torch.equal(torch.autograd.grad(alone, image)[0], gradient)
    others = ((image[:10], target[:10], 0.2), (image, target, 0.0), (image.double(), target.double(), 0.2))
    for *pair, weight in others:  # too small, without SSIM, in another precision
        elsewhere = image_losses(pair[0], None, pair[1], SSIM(data_range=1.0, channel=3), weight)[0]
        assert "_Loss" not in type(elsewhere.grad_fn).__name__


def reduced(height, width, x, device="cpu"):
    """A view from ``x`` along the z axis, a little turned, of random blobs."""
    blobs = torch.rand(1, 3, height // 3, width // 3, generator=torch.Generator().manual_seed(height))
    image = torch.nn.functional.interpolate(blobs, (height, width), mode="bilinear")[0]
    eye, target = (x, -0.1 * x, 0.0), (0.9 * x, -0.1 * x, 1.0)
    camera = Camera.look_at(eye, target, (0.0, -1.0, 0.0), fov=40.0, width=width, height=height)
    K = torch.tensor([[1.1 * width, 0, width / 2 + 1], [0, 1.2 * width, height / 2], [0, 0, 1]])
    camera = camera._replace(K=K).to(device)
    return plane_sweep._reduced(Photo(camera, image.permute(1, 2, 0).contiguous().to(device), None), 1000)


def scores(device="cpu"):
    """Correlations with two images of other sizes; some planes leave them, and some lie behind them."""
    photo = reduced(35, 50, 0.0, device)
    others = [reduced(40, 45, 0.4, device), reduced(21, 70, -0.7, device)]
    rays = photo.rays(torch.arange(35, device=device)[:, None], torch.arange(50, device=device))
    facing = rays @ torch.tensor([0.3, 0.0, 0.954], device=device)
    planes = torch.linspace(-0.2, 2.0, 23, device=device)
    return plane_sweep._correlations(photo, others, rays, (-0.1, 1.7))(facing, planes)


def share_apart(ours, expected):
    """Share of the correlations that differ; single pixels may lie on the other side of an image's border."""
    return float(((ours - expected).abs() > 1e-3).float().mean())


def test_it_correlates_as_pytorch_does(monkeypatch):
    expected = scores()
    monkeypatch.setattr(plane_sweep, "kernels_where_possible", lambda *_: sweep.sweep_kernels(torch.device("cpu")))
    assert share_apart(scores(), expected) < 1e-3
    assert (expected == -1).any()
    assert 0.1 < (expected > 0.3).float().mean() < 0.9


@pytest.mark.gpu
def test_on_a_gpu_it_correlates_as_on_a_cpu():
    assert sweep.sweep_kernels(torch.device("cuda"))
    assert share_apart(scores("cuda").cpu(), scores()) < 1e-3
