"""The kernel of a plane sweep, compiled for the CPU, beside PyTorch's operations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from sundae_ns.gpu import fused_sweep
from sundae_ns.rendering.views import View
from sundae_ns.training import plane_sweep
from sundae_ns.training.extension import Photo


def reduced(height: int, width: int, x: float, device: str = "cpu") -> plane_sweep._Reduced:
    """A view from ``x`` along the z axis, a little turned, of random blobs."""
    generator = torch.Generator().manual_seed(height)
    image = torch.nn.functional.interpolate(
        torch.rand(1, 3, height // 3, width // 3, generator=generator), (height, width), mode="bilinear"
    )[0]
    angle = torch.tensor(0.1 * x)
    viewmat = torch.eye(4)
    viewmat[0, 0], viewmat[0, 2], viewmat[2, 0], viewmat[2, 2] = angle.cos(), angle.sin(), -angle.sin(), angle.cos()
    viewmat[0, 3], viewmat[1, 3] = -x, 0.1 * x
    K = torch.tensor([[1.1 * width, 0, width / 2 + 1], [0, 1.2 * width, height / 2], [0, 0, 1]])
    view = View(viewmat.to(device), K.to(device), width, height, 1.1 * width)
    return plane_sweep._reduced(Photo(view, image.permute(1, 2, 0).contiguous().to(device), None), 1000)


def scores(device: str = "cpu") -> torch.Tensor:
    """Correlations with two images of other sizes; some planes leave them, and some lie behind them."""
    photo = reduced(35, 50, 0.0, device)
    others = [reduced(40, 45, 0.4, device), reduced(21, 70, -0.7, device)]
    rays = photo.rays(torch.arange(35, device=device)[:, None], torch.arange(50, device=device))
    facing = rays @ torch.tensor([0.3, 0.0, 0.954], device=device)
    planes = torch.linspace(-0.2, 2.0, 23, device=device)
    return plane_sweep._correlations(photo, others, rays, (-0.1, 1.7))(facing, planes)


def apart(found: torch.Tensor, expected: torch.Tensor) -> float:
    """Share of the correlations that differ; single pixels may lie on the other side of an image's border."""
    return float(((found - expected).abs() > 1e-3).float().mean())


def test_it_correlates_as_pytorch_does(load_on_cpu: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = scores()
    loaded = load_on_cpu("sweep.cu", ("correlate",), fused_sweep.OPTIONS, torch.device("cpu"), 1)
    monkeypatch.setattr(plane_sweep, "_kernels", lambda image: loaded)
    assert apart(scores(), expected) < 1e-3
    assert (expected == -1).any()
    assert 0.1 < (expected > 0.3).float().mean() < 0.9


def test_it_compiles_for_gpus(compile_for_gpu: Callable[..., bytes]) -> None:
    assert compile_for_gpu("sweep.cu", "sm_75", fused_sweep.OPTIONS)


@pytest.mark.gpu
def test_on_a_gpu_it_correlates_as_on_a_cpu() -> None:
    assert plane_sweep._kernels(torch.zeros(1, device="cuda"))
    assert apart(scores("cuda").cpu(), scores()) < 1e-3
