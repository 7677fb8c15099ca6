"""The fused kernels: their very lines, compiled for the CPU, against the network layer by layer; and on a GPU."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import cast

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from sundae_ns.compensation import CompensationHead, HeadConfig, fused, kernels
from sundae_ns.compensation.fused_training import FusedTraining, _Pass, network_backward
from sundae_ns.errors import BackendError, SundaeError
from sundae_ns.gpu import nvrtc
from sundae_ns.gpu.cuda_graphs import MAX_SIZES, RECORD_AT

PICTURES_OF_FLOATS = """
typedef float T;
inline float load(T v) { return v; }
inline T store(float v) { return v; }
"""

Compile = Callable[[CompensationHead], kernels.Launches]


@pytest.fixture(scope="module")
def compiled(compile_kernels: Callable[..., kernels.Launches]) -> Compile:
    def compile_for(head: CompensationHead) -> kernels.Launches:
        options = kernels.definitions(head.net, head.config.mode == "residual")
        return compile_kernels(PICTURES_OF_FLOATS + kernels.SOURCE, kernels.FORWARD + kernels.BACKWARD, options)

    return compile_for


def make(**options: object) -> CompensationHead:
    torch.manual_seed(0)
    head = CompensationHead(HeadConfig(**{"size": "tiny", "num_features": 5, **options}))  # type: ignore[arg-type]
    for parameter in head.parameters():
        nn.init.normal_(parameter, std=0.3 if parameter.ndim == 1 else (parameter[0].numel()) ** -0.5)
    return head


def splatted(height: int, width: int, num_features: int, *, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Base, colours with features, and accumulation; depth lies beside them, as a rasteriser leaves it."""
    generator = torch.Generator().manual_seed(seed)
    everything = torch.rand(height, width, 4 + num_features, generator=generator)
    alpha = torch.rand(height, width, 1, generator=generator)
    base = torch.rand(height, width, 3, generator=generator)
    return base, everything[..., :-1], alpha


@torch.no_grad()
def by_kernels(head: CompensationHead, pictures: tuple[Tensor, Tensor, Tensor], compiled: Compile) -> Tensor:
    base, seen, alpha = pictures
    launches = compiled(head)
    folded = fused.folded_room(head.net, *base.shape[:2], base, torch.float32).fill_(torch.nan)
    fused.fold(seen, alpha, head.config.pixel_unshuffle, head.config.mode == "residual", folded, launches)
    last = fused.network(head.net, fused.Weights(head.net, torch.float32), folded, launches).last
    assert last is not None
    return fused.unfold(head.net, last, base, alpha, launches)


@pytest.mark.parametrize("mode", ["residual", "features"])
@pytest.mark.parametrize("pixel_unshuffle", [1, 2, 3, 4])
@torch.no_grad()
def test_the_same_picture(compiled: Compile, mode: str, pixel_unshuffle: int) -> None:
    head = make(mode=mode, pixel_unshuffle=pixel_unshuffle)
    pictures = splatted(37, 50, 5)
    torch.testing.assert_close(by_kernels(head, pictures, compiled), head(*pictures), rtol=1e-4, atol=1e-5)


@settings(max_examples=15, deadline=None)
@given(height=st.integers(1, 40), width=st.integers(1, 40), num_features=st.integers(1, 14), seed=st.integers(0, 99))
@torch.no_grad()
def test_at_any_size(compiled: Compile, height: int, width: int, num_features: int, seed: int) -> None:
    head = make(num_features=num_features)
    pictures = splatted(height, width, num_features, seed=seed)
    torch.testing.assert_close(by_kernels(head, pictures, compiled), head(*pictures), rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_compact_levels_and_wide_ones(compiled: Compile) -> None:
    for size in ("compact", "wide", "small"):
        head = make(size=size, num_features=13)
        pictures = splatted(20, 33, 13)
        torch.testing.assert_close(by_kernels(head, pictures, compiled), head(*pictures), rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_overflow_corrects_nothing(compiled: Compile) -> None:
    head = make()
    base, seen, alpha = splatted(16, 16, 5)
    seen[3, 4] = torch.inf
    out = by_kernels(head, (base, seen, alpha), compiled)
    assert torch.isfinite(out).all()
    assert torch.equal(out[3, 4], base[3, 4])


Gradients = list[Tensor]


def of_layers(head: CompensationHead, pictures: tuple[Tensor, Tensor, Tensor], to_out: Tensor) -> Gradients:
    """The picture, and gradients of splatted, accumulation and parameters by autograd."""
    base, *leaves = pictures[0], *(picture.clone().requires_grad_() for picture in pictures[1:])
    head.zero_grad()
    out = head(base, *leaves)
    (out * to_out).sum().backward()
    grads = [leaf.grad if leaf.grad is not None else torch.zeros_like(leaf) for leaf in leaves]
    return [out.detach(), *grads, *(p.grad.clone() for p in head.parameters() if p.grad is not None)]


def of_kernels(
    head: CompensationHead, pictures: tuple[Tensor, Tensor, Tensor], to_out: Tensor, training: FusedTraining
) -> Gradients:
    """The same by the kernels."""
    base, *leaves = pictures[0], *(picture.clone().requires_grad_() for picture in pictures[1:])
    head.zero_grad()
    out = training(*leaves, torch.float32)
    out = base + out if head.config.mode == "residual" else out
    (out * to_out).sum().backward()
    return [out.detach(), *(leaf.grad for leaf in leaves), *(p.grad.clone() for p in head.parameters())]


def assert_same(found: Gradients, expected: Gradients) -> None:
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-5 * max(1.0, float(b.abs().max())))


@pytest.mark.parametrize("mode", ["residual", "features"])
@pytest.mark.parametrize("pixel_unshuffle", [1, 2, 4])
def test_the_same_gradients(compiled: Compile, mode: str, pixel_unshuffle: int) -> None:
    head = make(mode=mode, pixel_unshuffle=pixel_unshuffle)
    training = FusedTraining(head.net, mode == "residual", compiled(head))
    for size in ((37, 50), (16, 16)):
        pictures, to_out = splatted(*size, 5), torch.randn(*size, 3)
        assert_same(of_kernels(head, pictures, to_out, training), of_layers(head, pictures, to_out))


@settings(max_examples=10, deadline=None)
@given(height=st.integers(1, 40), width=st.integers(1, 40), num_features=st.integers(1, 14), seed=st.integers(0, 99))
def test_the_same_gradients_at_any_size(
    compiled: Compile, height: int, width: int, num_features: int, seed: int
) -> None:
    head = make(num_features=num_features)
    pictures, to_out = splatted(height, width, num_features, seed=seed), torch.randn(height, width, 3)
    training = FusedTraining(head.net, True, compiled(head))
    both = zip(of_kernels(head, pictures, to_out, training), of_layers(head, pictures, to_out), strict=True)
    for found, expected in both:
        # By the norm: among so many pictures is one with an activation so near zero that rounding decides on its slope.
        assert float((found - expected).norm()) <= 2e-3 * max(float(expected.norm()), 1e-3)


class Played:
    """In place of a CUDA graph."""

    def __init__(self, replay: Callable[[], None]) -> None:
        self.replay = replay


def as_recorded(head: CompensationHead, height: int, width: int, launches: kernels.Launches) -> _Pass:
    """A pass whose results lie in the same place each time, as those of a recording do."""
    net = head.net
    weights = fused.Weights(net, torch.float32)
    folded = fused.folded_room(net, height, width, torch.empty(0), torch.float32).zero_()
    tape = fused.network(net, weights, folded, launches)
    assert tape.last is not None
    to_raw = torch.zeros_like(tape.last)
    to_folded, to_parameters = network_backward(net, weights, tape, to_raw, launches)

    def forward() -> None:
        for gradient in to_parameters:
            gradient.fill_(torch.nan)  # the two graphs share their memory
        weights.refresh()
        again = fused.network(net, weights, folded, launches)
        for old, new in zip([*tape.inputs, *tape.coarse, tape.last], [*again.inputs, *again.coarse, again.last]):
            if old is not folded:
                old.copy_(new)  # type: ignore[union-attr, arg-type]

    def backward() -> None:
        found, gradients = network_backward(net, weights, tape, to_raw, launches)
        to_folded.copy_(found)
        for old, new in zip(to_parameters, gradients, strict=True):
            old.copy_(new)

    graphs = [cast("torch.cuda.CUDAGraph", Played(run)) for run in (forward, backward)]
    return _Pass(weights, folded, tape, to_raw, to_folded, to_parameters, *graphs)


def test_gradients_of_what_is_played_are_not_copied_and_add_up(compiled: Compile) -> None:
    head = make()
    training = FusedTraining(head.net, True, compiled(head))
    made = as_recorded(head, 37, 50, compiled(head))
    training._recorded[37, 50, torch.float32, head.net.out.weight.data_ptr()] = made
    pictures, to_out = [splatted(37, 50, 5, seed=seed) for seed in range(3)], torch.randn(37, 50, 3)
    expected = [of_layers(head, seen, to_out)[3:] for seen in pictures]
    head.zero_grad()
    for seen in pictures[:2]:
        (training(seen[1].clone().requires_grad_(), seen[2], torch.float32) * to_out).sum().backward()
    assert_same([p.grad for p in head.parameters() if p.grad is not None], [a + b for a, b in zip(*expected[:2])])
    assert_same(of_kernels(head, pictures[2], to_out, training)[3:], expected[2])
    head.zero_grad()
    out = training(pictures[0][1].clone().requires_grad_(), pictures[0][2], torch.float32)
    other = torch.randn(37, 50, 3)
    (out * to_out).sum().backward(retain_graph=True)
    (out * other).sum().backward()
    twice = [p.grad.clone() for p in head.parameters() if p.grad is not None]
    assert_same(twice, of_layers(head, pictures[0], to_out + other)[3:])
    assert_same(of_kernels(head, pictures[2], to_out, training)[3:], expected[2])
    assert made.to_parameters is not None
    for parameter, gradient in zip(training._parameters, made.to_parameters):
        assert parameter.grad is not None
        assert parameter.grad.data_ptr() == gradient.data_ptr()


def test_gradients_of_an_earlier_picture_are_refused(compiled: Compile) -> None:
    head = make()
    training = FusedTraining(head.net, True, compiled(head))
    pictures = [splatted(16, 16, 5, seed=seed) for seed in range(2)]
    outs = [training(p[1].clone().requires_grad_(), p[2], torch.float32) for p in pictures]
    with pytest.raises(SundaeError, match=r"before that$"):
        outs[0].sum().backward()
    outs[1].sum().backward()


@torch.no_grad()
def test_a_head_that_cannot_be_recorded_is_shown_by_its_kernels(
    compiled: Compile, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*_: object) -> None:
        raise BackendError("no recordings today")

    head = make()
    pictures = splatted(16, 16, 5)
    expected = head(*pictures)
    launches = compiled(head)
    monkeypatch.setattr(fused, "compiled", lambda *_: launches)
    monkeypatch.setattr(head._inference, "_record", refuse)
    for _ in range(RECORD_AT + 2):
        torch.testing.assert_close(head._inference(*pictures, torch.float32), expected, rtol=1e-4, atol=1e-5)
    assert caplog.text.count("kernel by kernel: no recordings today") == 1


def test_late_gradients_of_what_is_played_are_refused(compiled: Compile) -> None:
    """Two pictures of one size lie in the same buffers."""
    head = make()
    training = FusedTraining(head.net, True, compiled(head))
    recorded = as_recorded(head, 16, 16, compiled(head))
    training._recorded[16, 16, torch.float32, head.net.out.weight.data_ptr()] = recorded
    pictures = [splatted(16, 16, 5, seed=seed) for seed in range(2)]
    outs = [training(seen[1].clone().requires_grad_(), seen[2], torch.float32) for seen in pictures]
    with pytest.raises(SundaeError, match=r"before that$"):
        outs[0].sum().backward()
    outs[1].sum().backward()


def test_kernels_compile_for_gpus_that_have_the_types() -> None:
    try:
        nvrtc._library("nvrtc")
    except BackendError as error:
        pytest.skip(f"no NVRTC here: {error}")
    for architecture, dtype, head in (
        ("sm_75", torch.float16, make(pixel_unshuffle=4)),
        ("sm_80", torch.bfloat16, make(size="large", mode="features")),
        ("sm_90", torch.float16, make()),
    ):
        options = kernels.definitions(head.net, head.config.mode == "residual")
        code = nvrtc.compile_cubin(kernels.program(dtype), architecture, options)
        assert all(name.encode() in code for name in kernels.FORWARD + kernels.BACKWARD)


@pytest.mark.gpu
@pytest.mark.parametrize(("precision", "tolerance"), [("bf16", 0.02), ("fp16", 0.003)])
@pytest.mark.parametrize("mode", ["residual", "features"])
@torch.no_grad()
def test_on_a_gpu_at_every_size_and_with_weights_that_change(precision: str, tolerance: float, mode: str) -> None:
    exact = make(mode=mode, size="compact", num_features=13, precision="fp32").cuda().eval()
    quick = make(mode=mode, size="compact", num_features=13, precision=precision).cuda().eval()
    sizes = [(33, 40)] * 5 + [(48, 64)] * 4 + [(33, 40), (16, 16)] + [(31, 30)] * 3 + [(20, 30)] * 3 + [(8, 8)] * 3
    kept = []
    for seed, (height, width) in enumerate([*sizes, *sizes]):
        for parameter in exact.parameters():
            parameter += 0.01 * torch.randn_like(parameter)
        quick.load_state_dict(exact.state_dict())
        pictures = tuple(picture.cuda() for picture in splatted(height, width, 13, seed=seed))
        found, expected = quick(*pictures), exact(*pictures)
        scale = float((expected - pictures[0]).abs().max())
        assert float((found - expected).abs().max()) < tolerance * scale
        kept.append((found, found.clone()))
    assert quick._can_fuse
    assert len(quick._inference._recorded) == MAX_SIZES
    for found, copy in kept:  # nobody's picture was written over by a later one
        assert torch.equal(found, copy)


@pytest.mark.gpu
@torch.no_grad()
def test_recorded_and_unrecorded_pictures_are_equal() -> None:
    head = make(size="compact", num_features=13).cuda().eval()
    pictures = tuple(picture.cuda() for picture in splatted(64, 80, 13))
    shown = [head(*pictures) for _ in range(5)]
    assert len(head._inference._recorded) == 1
    for picture in shown[1:]:
        assert torch.equal(picture, shown[0])


@pytest.mark.gpu
@torch.no_grad()
def test_without_kernels_the_layers_run(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    def refuse(*_: object) -> kernels.Launches:
        raise BackendError("no compiler: install one")

    head = make().cuda().eval()
    pictures = tuple(picture.cuda() for picture in splatted(16, 16, 5))
    expected = head(*pictures)
    monkeypatch.setattr(fused, "compiled", refuse)
    with caplog.at_level(logging.WARNING):
        found, again = head(*pictures), head(*pictures)
    assert caplog.text.count("layer by layer") == 1
    torch.testing.assert_close(found, expected, rtol=0.05, atol=0.05)
    torch.testing.assert_close(again, found)


@pytest.mark.gpu
@pytest.mark.parametrize("mode", ["residual", "features"])
def test_training_on_a_gpu_is_that_of_the_layers(mode: str) -> None:
    """Values and gradients, at more sizes than are recorded, and after a step that changed the weights."""
    exact = make(mode=mode, size="compact", num_features=13, precision="fp32").cuda()
    layers = make(mode=mode, size="compact", num_features=13, fused=False).cuda()
    quick = make(mode=mode, size="compact", num_features=13).cuda()
    sizes = [(33, 40), (48, 64), (33, 40), (31, 30), (16, 16), (24, 56), (16, 16), (8, 8)]
    norms = []
    for seed, (height, width) in enumerate(sizes):
        with torch.no_grad():
            for parameter in exact.parameters():
                parameter += 0.01 * torch.randn_like(parameter)
        for head in (layers, quick):
            head.load_state_dict(exact.state_dict())
        pictures = tuple(picture.cuda() for picture in splatted(height, width, 13, seed=seed))
        to_out = torch.randn(height, width, 3, device="cuda")
        results = (of_layers(head, pictures, to_out) for head in (quick, layers, exact))
        by_result = [[found - whole, rounded - whole, whole] for found, rounded, whole in zip(*results, strict=True)]
        norms.append(torch.tensor([[float(value.norm()) for value in values] for values in by_result]))
        assert quick._can_fuse
    # bf16 rounds on both sides, at different places. Where that turns an activation's sign, one small picture differs by
    # several percent; all of them together by no more than the layers do themselves, four times over.
    together = torch.stack(norms).square().sum(dim=0).sqrt()
    for table, slack in [*((each, 0.1) for each in norms), (together, 0.01)]:
        error, allowed, whole = table.unbind(1)
        assert (error <= 4 * allowed + slack * whole).all(), (error, allowed, whole)
    assert len(quick._training._recorded) == MAX_SIZES


@pytest.mark.gpu
def test_gradients_of_several_pictures_add_up_on_a_gpu() -> None:
    """Recorded passes leave the parameters' gradients where the next ones write."""
    head = make(size="compact", num_features=13).cuda()
    parts, sizes = [], [(33, 40), (48, 64), (33, 40), (33, 40)]
    shown = [tuple(picture.cuda() for picture in splatted(*size, 13, seed=n)) for n, size in enumerate(sizes)]
    for pictures in shown:
        parts.append(of_layers(head, pictures, torch.ones(3, device="cuda"))[3:])
    assert len(head._training._recorded) == 2
    head.zero_grad()
    for base, *leaves in shown:
        head(base, *(leaf.clone().requires_grad_() for leaf in leaves)).sum().backward()
    for parameter, *of_each in zip(head.parameters(), *parts, strict=True):
        assert parameter.grad is not None
        torch.testing.assert_close(parameter.grad, torch.stack(of_each).sum(dim=0), rtol=1e-4, atol=1e-4)
