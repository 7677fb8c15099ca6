"""Projection and harmonics against gsplat's own torch functions: values and gradients."""

import pytest
import torch
from splat_inputs import geometry

from sundae_ns.core.covariance import rotation_matrices
from sundae_ns.rasterize.reference import ReferenceBackend, harmonic_basis, project

gsplat_torch = pytest.importorskip("gsplat.cuda._torch_impl")

WIDTH, HEIGHT = 70, 50


def _primitives(n=400):
    torch.manual_seed(0)
    # Off-axis and near ones too, so that the limit on the slope is active for many.
    means = (torch.rand(n, 3, dtype=torch.float64) - 0.5) * torch.tensor([6.0, 6.0, 4.0]) + torch.tensor([0, 0, 2.2])
    quats = torch.randn(n, 4, dtype=torch.float64)
    scales = torch.rand(n, 3, dtype=torch.float64) * 0.3 + 1e-3
    return [means, quats, scales]


def _camera():
    angle = torch.tensor(0.3, dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 0] = viewmat[2, 2] = angle.cos()
    viewmat[0, 2], viewmat[2, 0] = angle.sin(), -angle.sin()
    viewmat[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
    K = torch.tensor([[60.0, 0, 33.0], [0, 55.0, 26.0], [0, 0, 1]], dtype=torch.float64)
    return viewmat, K


def _gradients(outputs, inputs):
    torch.manual_seed(1)
    loss = sum((output * torch.rand_like(output)).sum() for output in outputs)
    return list(torch.autograd.grad(loss, inputs))


def _worst(ours, theirs):
    """Largest deviation, relative where values exceed one."""
    return ((ours - theirs).abs() / theirs.abs().clamp(min=1)).max().item()


def test_covariance_matches_gsplat():
    _, quats, scales = _primitives()
    inputs = [quats.requires_grad_(), scales.requires_grad_()]
    root = rotation_matrices(quats) * scales[:, None, :]
    ours = root @ root.mT
    theirs, _ = gsplat_torch._quat_scale_to_covar_preci(quats, scales, True, False)
    # measured: 0 in values, 1.1e-16 in gradients (float64)
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-14)
    for a, b in zip(_gradients([ours], inputs), _gradients([theirs], inputs), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("antialiased", [False, True])
def test_projection_matches_gsplat(antialiased):
    inputs = [value.requires_grad_() for value in _primitives()]
    means, quats, scales = inputs
    viewmat, K = _camera()
    ours = project(geometry(means, quats, scales, viewmat, K, WIDTH, HEIGHT))
    covars, _ = gsplat_torch._quat_scale_to_covar_preci(quats, scales, True, False)
    radii, means2d, depths, conics, compensations = gsplat_torch._fully_fused_projection(
        means, covars, viewmat[None], K[None], WIDTH, HEIGHT, calc_compensations=antialiased
    )
    if radii.dim() == 3:
        # gsplat 1.5 has one radius per axis and culls invisible Gaussians; the reference follows 1.4.
        seen = (radii[0] > 0).all(dim=-1) & (ours.radii > 0)
    else:
        seen = radii[0] > 0
        assert torch.equal(ours.radii, radii[0])
    assert 50 < int(seen.sum()) < 350  # both kinds are there
    pairs = [(ours.means2d, means2d[0]), (ours.depths, depths[0]), (ours.conics, conics[0])]
    if antialiased:
        pairs.append((ours.compensations, compensations[0]))
    for a, b in pairs:
        assert _worst(a[seen], b[seen]) < 1e-13  # measured: 3.2e-15
    ours_grad = _gradients([a[seen] for a, _ in pairs], inputs)
    theirs_grad = _gradients([b[seen] for _, b in pairs], inputs)
    for a, b in zip(ours_grad, theirs_grad, strict=True):
        assert _worst(a, b) < 1e-11  # measured: 1.1e-13


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_harmonics_match_gsplat(degree):
    torch.manual_seed(2)
    directions = torch.randn(200, 3, dtype=torch.float64, requires_grad=True)
    coeffs = torch.randn(200, 25, 3, dtype=torch.float64, requires_grad=True)
    ours = ReferenceBackend().spherical_harmonics(degree, directions, coeffs)
    theirs = gsplat_torch._spherical_harmonics(degree, directions, coeffs)
    assert _worst(ours, theirs) < 1e-13  # measured: 2.2e-15
    inputs = [coeffs] if degree == 0 else [directions, coeffs]
    for a, b in zip(_gradients([ours], inputs), _gradients([theirs], inputs), strict=True):
        assert _worst(a, b) < 1e-13  # measured: 3.1e-15


def test_harmonics_are_orthonormal():
    """The mean over the sphere of a product of two harmonics is 1 / 4 pi if they are the same, else 0."""
    torch.manual_seed(3)
    nodes, weights = torch.linalg.eigh(_legendre_jacobi(8))
    z, weights = nodes, weights[0].square()  # Gauss-Legendre, exact to degree 15
    phi = torch.arange(16, dtype=torch.float64) * (2 * torch.pi / 16)
    radius = (1 - z * z).sqrt()[:, None]
    directions = torch.stack(torch.broadcast_tensors(radius * phi.cos(), radius * phi.sin(), z[:, None]), dim=-1)
    basis = harmonic_basis(4, directions.reshape(-1, 3))
    gram = torch.einsum("nq,ni,nj->ij", weights.repeat_interleave(16)[:, None] / 16, basis, basis)
    torch.testing.assert_close(gram, torch.eye(25, dtype=torch.float64) / (4 * torch.pi), rtol=0, atol=1e-13)


def _legendre_jacobi(n):
    k = torch.arange(1, n, dtype=torch.float64)
    off = k / (4 * k * k - 1).sqrt()
    return torch.diag(off, 1) + torch.diag(off, -1)
