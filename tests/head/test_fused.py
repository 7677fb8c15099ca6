"""The fused kernels: the CUDA source, compiled for the CPU, against the network layer by layer; and on a GPU."""

import logging

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from sundae_ns.core.errors import BackendError
from sundae_ns.head import fused
from sundae_ns.head.head import CompensationHead, HeadConfig


@pytest.fixture(autouse=True, scope="module")
def on_cpu(load_on_cpu):
    """Float32 images, which only these tests use, are those of the CPU."""
    on_gpu = fused.load_kernels

    def load(file, names, options, device):
        return (load_on_cpu if device.type == "cpu" else on_gpu)(file, names, options, device)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fused, "load_kernels", load)
        patch.setitem(fused._TYPES, torch.float32, "-DFP32")
        yield


def make(**options):
    torch.manual_seed(0)
    head = CompensationHead(HeadConfig(**{"size": "tiny", "num_features": 5, **options}))
    for parameter in head.parameters():
        nn.init.normal_(parameter, std=0.3 if parameter.ndim == 1 else (parameter[0].numel()) ** -0.5)
    return head


def splatted(height, width, num_features, *, seed=0):
    """Base, colours with features, and accumulation; colours are a slice of a tensor, as from a rasteriser."""
    generator = torch.Generator().manual_seed(seed)
    everything = torch.rand(height, width, 4 + num_features, generator=generator)
    alpha = torch.rand(height, width, 1, generator=generator)
    return torch.rand(height, width, 3, generator=generator), everything[..., :-1], alpha


@torch.no_grad()
def by_kernels(head, images):
    return fused.compensated(head.net, head.config.mode == "residual", *images, torch.float32)


@torch.no_grad()
def test_overflowing_pixels_are_not_corrected():
    head = make()
    base, seen, alpha = splatted(16, 16, 5)
    seen[3, 4] = torch.inf
    out = by_kernels(head, (base, seen, alpha))
    assert torch.isfinite(out).all()
    assert torch.equal(out[3, 4], base[3, 4])


def gradients(head, images, grad_out, *, kernels=False):
    """The image, and gradients of splatted values, accumulation and parameters, by the layers or by the kernels."""
    base, *leaves = images[0], *(image.clone().requires_grad_() for image in images[1:])
    head.zero_grad()
    if kernels:
        residual = head.config.mode == "residual"
        out = fused.correction(head.net, residual, *leaves, torch.float32) + (base if residual else 0)
    else:
        out = head(base, *leaves)
    (out * grad_out).sum().backward()
    grads = [leaf.grad if leaf.grad is not None else torch.zeros_like(leaf) for leaf in leaves]
    return [out.detach(), *grads, *(p.grad.clone() for p in head.parameters() if p.grad is not None)]


def test_a_second_derivative_is_refused():
    net, (_, seen, alpha) = make().net, splatted(8, 8, 5)
    image = fused.correction(net, True, seen.requires_grad_(), alpha, torch.float32)
    (gradient,) = torch.autograd.grad(image.square().sum(), seen, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


KINDS = [{"mode": mode, "pixel_unshuffle": fold} for mode in ("residual", "features") for fold in (1, 2, 3, 4)]


@pytest.mark.parametrize("workers", [37, fused.MOST_WORKERS])
@pytest.mark.parametrize("options", [*KINDS, {"size": "compact"}, {"size": "wide"}], ids=str)
def test_same_image_and_gradients(options, workers, monkeypatch):
    """Also where few threads sum over the pixels."""
    monkeypatch.setattr(fused, "MOST_WORKERS", workers)
    head, images, grad_out = make(**options), splatted(37, 50, 5), torch.randn(37, 50, 3)
    with torch.autocast("cpu", torch.bfloat16):  # as nerfstudio's mixed precision, whose types the kernels do not read
        ours = gradients(head, images, grad_out, kernels=True)
    both = ours, gradients(head, images, grad_out)
    torch.testing.assert_close(by_kernels(head, images), both[1][0], rtol=1e-4, atol=1e-5)
    for found, expected in zip(*both, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-5 * max(1.0, float(expected.abs().max())))


@given(height=st.integers(1, 40), width=st.integers(1, 40), num_features=st.integers(1, 14), seed=st.integers(0, 99))
def test_same_image_and_gradients_at_any_size(height, width, num_features, seed):
    head = make(num_features=num_features)
    images, grad_out = splatted(height, width, num_features, seed=seed), torch.randn(height, width, 3)
    torch.testing.assert_close(by_kernels(head, images), head(*images).detach(), rtol=1e-4, atol=1e-5)
    both = gradients(head, images, grad_out, kernels=True), gradients(head, images, grad_out)
    for found, expected in zip(*both, strict=True):
        # Compare norms: some image has an activation so near zero that rounding decides its slope.
        assert float((found - expected).norm()) <= 2e-3 * max(float(expected.norm()), 1e-3)


def test_kernels_compile_for_gpus_that_have_the_types(compile_for_gpu):
    for architecture, head in (("sm_80", make(pixel_unshuffle=4)), ("sm_90", make(size="regular", mode="features"))):
        options = fused.head_options(head.net, head.config.mode == "residual")
        code = compile_for_gpu("head.cu", architecture, (fused._TYPES[torch.bfloat16], *options))
        assert all(name.encode() in code for name in fused.KERNELS)


@pytest.mark.gpu
@pytest.mark.parametrize("mode", ["residual", "features"])
@torch.no_grad()
def test_on_a_gpu_at_any_size_with_changing_weights(mode):
    exact = make(mode=mode, size="compact", num_features=13, precision="fp32").cuda().eval()
    quick = make(mode=mode, size="compact", num_features=13).cuda().eval()
    sizes = [(33, 40)] * 5 + [(48, 64)] * 4 + [(33, 40), (16, 16)] + [(31, 30)] * 3 + [(20, 30)] * 3 + [(8, 8)] * 3
    for seed, (height, width) in enumerate([*sizes, *sizes]):
        for parameter in exact.parameters():
            parameter += 0.01 * torch.randn_like(parameter)
        quick.load_state_dict(exact.state_dict())
        images = tuple(image.cuda() for image in splatted(height, width, 13, seed=seed))
        found, expected = quick(*images), exact(*images)
        assert float((found - expected).abs().max()) < 0.02 * float((expected - images[0]).abs().max())
    assert quick._can_fuse


@pytest.mark.gpu
@torch.no_grad()
def test_without_kernels_the_layers_run(monkeypatch, caplog):
    def refuse(*_):
        raise BackendError("no compiler: install one")

    head = make().cuda().eval()
    images = tuple(image.cuda() for image in splatted(16, 16, 5))
    expected = head(*images)
    monkeypatch.setattr(fused, "head_kernels", refuse)
    with caplog.at_level(logging.WARNING):
        found, again = head(*images), head(*images)
    assert caplog.text.count("layer by layer") == 1
    torch.testing.assert_close(found, expected, rtol=0.05, atol=0.05)
    torch.testing.assert_close(again, found)


@pytest.mark.gpu
@pytest.mark.parametrize("mode", ["residual", "features"])
def test_training_on_a_gpu_matches_the_layers(mode):
    """Values and gradients, at more sizes than are recorded, with weights that change between steps."""
    exact = make(mode=mode, size="compact", num_features=13, precision="fp32").cuda()
    layers = make(mode=mode, size="compact", num_features=13).cuda()
    layers._can_fuse = False
    quick = make(mode=mode, size="compact", num_features=13).cuda()
    sizes = [(33, 40), (48, 64), (33, 40), (31, 30), (16, 16), (24, 56), (16, 16), (8, 8)]
    norms = []
    for seed, (height, width) in enumerate(sizes):
        with torch.no_grad():
            for parameter in exact.parameters():
                parameter += 0.01 * torch.randn_like(parameter)
        for head in (layers, quick):
            head.load_state_dict(exact.state_dict())
        images = tuple(image.cuda() for image in splatted(height, width, 13, seed=seed))
        grad_out = torch.randn(height, width, 3, device="cuda")
        results = (gradients(head, images, grad_out) for head in (quick, layers, exact))
        by_result = [[found - whole, rounded - whole, whole] for found, rounded, whole in zip(*results, strict=True)]
        norms.append(torch.tensor([[float(value.norm()) for value in values] for values in by_result]))
        assert quick._can_fuse
    # Both sides round to bf16, at different places. Where this flips an activation's sign, one small image differs by
    # several percent; all images together by no more than four times the error of the layers.
    together = torch.stack(norms).square().sum(dim=0).sqrt()
    for table, slack in [*((each, 0.1) for each in norms), (together, 0.01)]:
        error, allowed, whole = table.unbind(1)
        assert (error <= 4 * allowed + slack * whole).all(), (error, allowed, whole)


@pytest.mark.gpu
def test_gradients_of_several_images_add_up_on_a_gpu():
    """Gradients of parameters lie in buffers that later passes overwrite."""
    head = make(size="compact", num_features=13).cuda()
    parts, sizes = [], [(33, 40), (48, 64), (33, 40), (33, 40)]
    shown = [tuple(image.cuda() for image in splatted(*size, 13, seed=n)) for n, size in enumerate(sizes)]
    for images in shown:
        parts.append(gradients(head, images, torch.ones(3, device="cuda"))[3:])
    head.zero_grad()
    for base, *leaves in shown:
        head(base, *(leaf.clone().requires_grad_() for leaf in leaves)).sum().backward()
    for parameter, *of_each in zip(head.parameters(), *parts, strict=True):
        torch.testing.assert_close(parameter.grad, torch.stack(of_each).sum(dim=0), rtol=1e-4, atol=1e-4)
