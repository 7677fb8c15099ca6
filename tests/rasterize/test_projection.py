"""Projection and harmonics of the reference against gsplat's own torch functions: values and gradients."""

import pytest
import torch
from gsplat.cuda import _torch_impl as gsplat_torch
from splat_inputs import geometry

from sundae_ns.rasterize.reference import ReferenceBackend, project

WIDTH, HEIGHT = 70, 50


def _gradients(outputs, inputs):
    torch.manual_seed(1)
    return list(torch.autograd.grad(sum((output * torch.rand_like(output)).sum() for output in outputs), inputs))


def _worst(ours, theirs):
    """Largest deviation, relative where values exceed one."""
    return ((ours - theirs).abs() / theirs.abs().clamp(min=1)).max().item()


def test_projection_matches_gsplat():
    n, double = 400, torch.float64
    # Off-axis and near ones too, so that the limit on the slope is active for many.
    means = (torch.rand(n, 3, dtype=double) - 0.5) * torch.tensor([6.0, 6.0, 4.0]) + torch.tensor([0, 0, 2.2])
    inputs = [means, torch.randn(n, 4, dtype=double), torch.rand(n, 3, dtype=double) * 0.3 + 1e-3]
    means, quats, scales = (value.requires_grad_() for value in inputs)
    K = torch.tensor([[60.0, 0, 33.0], [0, 55.0, 26.0], [0, 0, 1]], dtype=double)
    viewmat = torch.eye(4, dtype=double)
    viewmat[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0, -0.1, -0.3], [0.1, 0, 0.2], [0.3, -0.2, 0]]))
    viewmat[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
    ours = project(geometry(means, quats, scales, viewmat, K, WIDTH, HEIGHT))
    covars, _ = gsplat_torch._quat_scale_to_covar_preci(quats, scales, True, False)
    radii, *theirs = gsplat_torch._fully_fused_projection(
        means, covars, viewmat[None], K[None], WIDTH, HEIGHT, calc_compensations=True
    )
    if radii.dim() == 3:
        # gsplat 1.5 has one radius per axis and culls invisible Gaussians; the reference follows 1.4.
        seen = (radii[0] > 0).all(dim=-1) & (ours.radii > 0)
    else:
        seen = radii[0] > 0
        assert torch.equal(ours.radii, radii[0])
    assert 50 < int(seen.sum()) < 350  # both kinds are there
    found = [value[seen] for value in (ours.means2d, ours.depths, ours.conics, ours.compensations)]
    expected = [value[0, seen] for value in theirs]
    for a, b in zip(found, expected, strict=True):
        assert _worst(a, b) < 1e-13  # measured: 3.2e-15
    for a, b in zip(_gradients(found, inputs), _gradients(expected, inputs), strict=True):
        assert _worst(a, b) < 1e-11  # measured: 1.1e-13


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_harmonics_match_gsplat(degree):
    directions = torch.randn(200, 3, dtype=torch.float64, requires_grad=True)
    coeffs = torch.randn(200, 25, 3, dtype=torch.float64, requires_grad=True)
    ours = ReferenceBackend().spherical_harmonics(degree, directions, coeffs[:, 0], coeffs[:, 1:])
    theirs = gsplat_torch._spherical_harmonics(degree, directions, coeffs)
    assert _worst(ours, theirs) < 1e-13  # measured: 2.2e-15
    inputs = [coeffs] if degree == 0 else [directions, coeffs]
    for a, b in zip(_gradients([ours], inputs), _gradients([theirs], inputs), strict=True):
        assert _worst(a, b) < 1e-13  # measured: 3.1e-15
