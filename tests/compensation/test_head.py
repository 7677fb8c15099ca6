"""The head: its two modes, its start, and what it must not depend on."""

from __future__ import annotations

import pytest
import torch

from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.errors import ConfigError


def inputs(height: int = 33, width: int = 40, features: int = 5) -> tuple[torch.Tensor, ...]:
    colors = torch.rand(height, width, 3)
    alpha = torch.rand(height, width, 1)
    return (colors + (1 - alpha) * 0.5).clamp(0, 1), colors, torch.randn(height, width, features), alpha


def head(**options: object) -> CompensationHead:
    return CompensationHead(HeadConfig(size="tiny", num_features=5, **options))  # type: ignore[arg-type]


def perturb(module: torch.nn.Module) -> None:
    """Move the zero start away from zero, as training does."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += 0.1 * torch.randn_like(parameter)


def test_residual_starts_at_the_base_exactly() -> None:
    base, colors, features, alpha = inputs()
    assert torch.equal(head()(base, colors, features, alpha), base)


def test_residual_leaves_empty_pixels_alone() -> None:
    base, colors, features, alpha = inputs()
    module = head()
    perturb(module)
    alpha[:10] = 0
    out = module(base, colors, features, alpha)
    assert torch.equal(out[:10], base[:10])
    assert not torch.allclose(out[10:], base[10:])


def test_residual_does_not_depend_on_the_background() -> None:
    base, colors, features, alpha = inputs()
    module = head()
    perturb(module)
    shifted = base + 0.1
    difference = module(shifted, colors, features, alpha) - module(base, colors, features, alpha)
    assert torch.allclose(difference, torch.full_like(difference, 0.1), atol=1e-6)


def test_features_mode_sees_features_alone() -> None:
    base, colors, features, alpha = inputs()
    module = head(mode="features")
    out = module(base, colors, features, alpha)
    assert torch.equal(out, module(base * 0, colors * 0, features, alpha * 0))
    assert not torch.equal(out, module(base, colors, features + 1, alpha))


@pytest.mark.parametrize("mode", ["residual", "features"])
def test_a_few_steps_learn(mode: str) -> None:
    base, colors, features, _ = inputs()
    alpha = torch.ones(33, 40, 1)  # the residual head has no say where nothing was splatted
    target = (base * 0.8).detach()
    module = head(mode=mode)
    features.requires_grad_()
    optimizer = torch.optim.Adam([*module.parameters(), features], lr=1e-2)

    def loss() -> torch.Tensor:
        return (module(base, colors, features, alpha) - target).abs().mean()

    first = loss().item()
    for _ in range(60):
        optimizer.zero_grad()
        value = loss()
        value.backward()
        optimizer.step()
    assert value.item() < 0.6 * first
    assert features.grad is not None
    assert features.grad.abs().sum() > 0


@pytest.mark.parametrize("options", [{"num_features": 0}, {"pixel_unshuffle": 0}, {"mode": "off"}])
def test_bad_options(options: dict[str, object]) -> None:
    with pytest.raises(ConfigError) as error:
        CompensationHead(HeadConfig(**options))  # type: ignore[arg-type]
    assert "\n" not in str(error.value)


WILD = {
    "large": lambda t: 1e4 * t,
    "large and negative": lambda t: -1e4 * t,
    "zero": torch.zeros_like,
    "one spike": lambda t: t.index_fill(1, torch.tensor([7], device=t.device), 1e4),
}


@pytest.mark.parametrize("kind", WILD)
@pytest.mark.parametrize("mode", ["residual", "features"])
def test_wild_inputs_give_finite_pictures(mode: str, kind: str) -> None:
    base, colors, features, alpha = inputs()
    module = head(mode=mode)
    perturb(module)
    features = WILD[kind](features).requires_grad_()
    out = module(base, WILD[kind](colors), features, alpha)
    out.square().mean().backward()
    assert torch.isfinite(out).all()
    assert torch.isfinite(features.grad).all()


@pytest.mark.parametrize("mode", ["residual", "features"])
def test_training_ten_times_too_fast_may_be_bad_but_not_broken(mode: str) -> None:
    torch.manual_seed(0)
    module = head(mode=mode, pixel_unshuffle=2)
    optimizer = torch.optim.Adam(module.parameters(), lr=1e-2)  # the methods have 1e-3 at most
    pictures = [inputs(16, 16) for _ in range(4)]
    truths = [torch.rand(16, 16, 3) for _ in pictures]
    for step in range(1000):
        optimizer.zero_grad()
        (module(*pictures[step % 4]) - truths[step % 4]).abs().mean().backward()
        optimizer.step()
    assert all(torch.isfinite(module(*picture)).all() for picture in pictures)


@pytest.mark.gpu
@pytest.mark.parametrize("kind", WILD)
@pytest.mark.parametrize("precision", ["bf16", "fp16"])
@torch.no_grad()
def test_half_precision_of_wild_inputs_is_finite(precision: str, kind: str) -> None:
    """What does not fit into the numbers of half precision is left uncompensated."""
    base, colors, features, alpha = (t.cuda() for t in inputs())
    module = head(precision=precision).cuda()
    perturb(module)
    assert torch.isfinite(module(base, WILD[kind](colors), WILD[kind](features), alpha)).all()


@pytest.mark.gpu
@pytest.mark.parametrize("precision", ["bf16", "fp16"])
def test_half_precision_is_close(precision: str) -> None:
    tensors = [t.cuda() for t in inputs(features=5)]
    module = head(precision=precision).cuda()
    perturb(module)
    exact = CompensationHead(HeadConfig(size="tiny", num_features=5, precision="fp32")).cuda()
    exact.load_state_dict(module.state_dict())
    out = module(*tensors)
    assert out.dtype == torch.float32
    scale = (exact(*tensors) - tensors[0]).abs().mean()
    assert (out - exact(*tensors)).abs().mean() < 0.03 * scale


@pytest.mark.gpu
@pytest.mark.parametrize("mode", ["residual", "features"])
def test_recorded_training_is_the_same(mode: str) -> None:
    """Replayed as a CUDA graph, the head gives the values and gradients that it gives without, at every size."""
    torch.manual_seed(0)
    eager, graphed = head(mode=mode, cuda_graph=False).cuda(), head(mode=mode, cuda_graph=True).cuda()
    perturb(eager)
    graphed.load_state_dict(eager.state_dict())
    for height, width in ((33, 40), (48, 64), (33, 40), (31, 30), (16, 16), (24, 56)):  # more than are recorded
        tensors = [t.cuda() for t in inputs(height, width)]
        results = []
        for module in (eager, graphed):
            features = tensors[2].clone().requires_grad_()
            out = module(tensors[0], tensors[1], features, tensors[3])
            module.zero_grad()
            out.square().mean().backward()
            results.append([out.detach(), features.grad, *(p.grad for p in module.parameters())])
        for a, b in zip(*results, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-2, atol=1e-5)  # bf16, whose atomics are not ordered


@pytest.mark.gpu
@pytest.mark.parametrize("precision", ["fp32", "bf16", "fp16"])
@torch.no_grad()
def test_replayed_pictures_are_the_same(precision: str) -> None:
    """At every size, in any order, and with weights that have changed since the recording."""
    torch.manual_seed(0)
    eager = head(precision=precision).cuda().eval()
    replayed = head(precision=precision, cuda_graph_inference=True).cuda().eval()
    sizes = [(33, 40)] * 5 + [(48, 64)] * 4 + [(33, 40), (16, 16)] + [(31, 30)] * 3 + [(20, 30)] * 3 + [(8, 8)] * 3
    kept = []
    for height, width in [*sizes, *sizes]:
        perturb(eager)
        replayed.load_state_dict(eager.state_dict())
        tensors = [t.cuda() for t in inputs(height, width)]
        found, expected = replayed(*tensors), eager(*tensors)
        torch.testing.assert_close(found, expected)
        kept.append((found, expected))
    assert len(replayed._replayed._recorded) == 4
    for found, expected in kept:  # nobody's picture was written over by a later one
        torch.testing.assert_close(found, expected)
