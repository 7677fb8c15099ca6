"""The head: its two modes, its initialisation, and its invariances."""

from __future__ import annotations

import os

import pytest
import torch

from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.errors import ConfigError


def inputs(height: int = 33, width: int = 40, features: int = 5) -> tuple[torch.Tensor, ...]:
    colors = torch.rand(height, width, 3)
    alpha = torch.rand(height, width, 1)
    splatted = torch.cat([colors, torch.randn(height, width, features)], dim=2)
    return (colors + (1 - alpha) * 0.5).clamp(0, 1), splatted, alpha


def head(**options: object) -> CompensationHead:
    return CompensationHead(HeadConfig(size="tiny", num_features=5, **options))  # type: ignore[arg-type]


def perturb(module: torch.nn.Module) -> None:
    """Move the zero start away from zero, as training does."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += 0.1 * torch.randn_like(parameter)


def test_residual_starts_at_the_base_exactly() -> None:
    base, splatted, alpha = inputs()
    assert torch.equal(head()(base, splatted, alpha), base)


def test_residual_leaves_empty_pixels_alone() -> None:
    base, splatted, alpha = inputs()
    module = head()
    perturb(module)
    alpha[:10] = 0
    out = module(base, splatted, alpha)
    assert torch.equal(out[:10], base[:10])
    assert not torch.allclose(out[10:], base[10:])


def test_residual_does_not_depend_on_the_background() -> None:
    base, splatted, alpha = inputs()
    module = head()
    perturb(module)
    shifted = base + 0.1
    difference = module(shifted, splatted, alpha) - module(base, splatted, alpha)
    assert torch.allclose(difference, torch.full_like(difference, 0.1), atol=1e-6)


def test_features_mode_sees_features_alone() -> None:
    base, splatted, alpha = inputs()
    module = head(mode="features")
    out = module(base, splatted, alpha)
    no_colors = torch.cat([torch.zeros_like(splatted[..., :3]), splatted[..., 3:]], dim=2)
    assert torch.equal(out, module(base * 0, no_colors, alpha * 0))
    assert not torch.equal(out, module(base, splatted + 1, alpha))


@pytest.mark.parametrize("mode", ["residual", "features"])
def test_a_few_steps_learn(mode: str) -> None:
    base, splatted, _ = inputs()
    alpha = torch.ones(33, 40, 1)  # the residual head corrects nothing where nothing was splatted
    target = (base * 0.8).detach()
    module = head(mode=mode)
    splatted.requires_grad_()
    optimizer = torch.optim.Adam([*module.parameters(), splatted], lr=1e-2)

    def loss() -> torch.Tensor:
        return (module(base, splatted, alpha) - target).abs().mean()

    first = loss().item()
    for _ in range(60):
        optimizer.zero_grad()
        value = loss()
        value.backward()
        optimizer.step()
    assert value.item() < 0.6 * first
    assert splatted.grad is not None
    assert splatted.grad[..., 3:].abs().sum() > 0


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
def test_wild_inputs_give_finite_images(mode: str, kind: str) -> None:
    base, splatted, alpha = inputs()
    module = head(mode=mode)
    perturb(module)
    splatted = WILD[kind](splatted).requires_grad_()
    out = module(base, splatted, alpha)
    out.square().mean().backward()
    assert torch.isfinite(out).all()
    assert torch.isfinite(splatted.grad).all()


@pytest.mark.parametrize("mode", ["residual", "features"])
def test_training_with_ten_times_the_rate_stays_finite(mode: str) -> None:
    torch.manual_seed(0)
    module = head(mode=mode, pixel_unshuffle=2)
    optimizer = torch.optim.Adam(module.parameters(), lr=1e-2)  # the methods have 1e-3 at most
    images = [inputs(16, 16) for _ in range(4)]
    truths = [torch.rand(16, 16, 3) for _ in images]
    for step in range(1000 if os.environ.get("SUNDAE_ALL_SEEDS") == "1" else 200):
        optimizer.zero_grad()
        (module(*images[step % 4]) - truths[step % 4]).abs().mean().backward()
        optimizer.step()
    assert all(torch.isfinite(module(*image)).all() for image in images)


@pytest.mark.parametrize(("capability", "dtype"), [((9, 0), torch.bfloat16), ((7, 5), torch.float32)])
def test_fp16_does_not_train(monkeypatch: pytest.MonkeyPatch, capability: tuple[int, int], dtype: torch.dtype) -> None:
    """Overflow in fp16 would be NaN in the gradients of all earlier layers."""
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: capability)
    module, gpu = head(precision="fp16"), torch.device("cuda")
    assert module._dtype(gpu) == dtype
    assert module._dtype(torch.device("cpu")) == torch.float32
    with torch.no_grad():
        assert module._dtype(gpu) == torch.float16
    assert head(precision="bf16")._dtype(gpu) == torch.bfloat16


@pytest.mark.gpu
@pytest.mark.parametrize("kind", WILD)
@pytest.mark.parametrize("precision", ["bf16", "fp16"])
@torch.no_grad()
def test_half_precision_of_wild_inputs_is_finite(precision: str, kind: str) -> None:
    """Values that overflow half precision are left uncompensated."""
    base, splatted, alpha = (t.cuda() for t in inputs())
    module = head(precision=precision).cuda()
    perturb(module)
    assert torch.isfinite(module(base, WILD[kind](splatted), alpha)).all()


@pytest.mark.gpu
@pytest.mark.parametrize("precision", ["bf16", "fp16"])
@torch.no_grad()
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


def test_a_resized_head_keeps_its_parameter_objects() -> None:
    head, wanted = (
        CompensationHead(HeadConfig(size="small")),
        HeadConfig(size="tiny", num_features=5, pixel_unshuffle=1),
    )
    optimizer, before = torch.optim.Adam(head.parameters(), lr=0.01), list(head.parameters())
    head.eval()
    head.resize(wanted)
    fresh = CompensationHead(wanted)
    assert all(a is b for a, b in zip(before, head.parameters(), strict=True))
    assert [p.shape for p in head.parameters()] == [p.shape for p in fresh.parameters()]
    assert str(head.net) == str(fresh.eval().net), "layers describe themselves"
    assert not any(module.training for module in head.modules())
    fresh.load_state_dict(head.state_dict())
    images = [torch.rand(9, 11, channels) for channels in (3, 3 + 5, 1)]
    assert torch.equal(head(*images), fresh(*images))
    head.train()(*images).square().mean().backward()
    optimizer.step()
    assert not torch.equal(head(*images), fresh(*images))
