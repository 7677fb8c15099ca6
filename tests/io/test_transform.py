"""Transformed fields give the same images from transformed cameras; survey coordinates; which way is up."""

import pytest
import torch

from sundae_ns.core.camera import Camera
from sundae_ns.io.coordinates import recentred, rotate_spherical_harmonics, similarity, upward
from sundae_ns.rasterize.interface import rasterize, select_backend, spherical_harmonics
from sundae_ns.rasterize.reference import ReferenceBackend
from sundae_ns.rasterize.types import Inputs

SCALE = 1.7
SIZE = 24


def rotation(seed=1):
    generator = torch.Generator().manual_seed(seed)
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    return q * q.det()


def transform():
    return torch.cat([rotation(), torch.tensor([[0.4], [-1.1], [0.7]], dtype=torch.float64)], dim=1)


def gaussians(degree=3, n=60):
    generator = torch.Generator().manual_seed(2)

    def normal(*shape):
        return torch.randn(n, *shape, generator=generator, dtype=torch.float64)

    return {
        "means": normal(3) * 0.6,
        # Elongated, so that a wrong rotation changes the image.
        "scales": (0.12 * torch.tensor([3.0, 1.0, 0.3], dtype=torch.float64)).log() + 0.1 * normal(3),
        "quats": normal(4),
        "features_dc": normal(3),
        "features_rest": 0.3 * normal((degree + 1) ** 2 - 1, 3),
        "opacities": normal(1),
    }


def camera():
    camera = torch.eye(4, dtype=torch.float64)
    camera[:3, :3] = rotation(3)
    camera[:3, 3] = torch.tensor([0.1, -0.2, 3.0])
    return camera


def moved_camera():
    """World-to-camera of the transformed camera; its coordinates are ``SCALE`` times as large."""
    cam, (turn, shift) = camera(), transform().split([3, 1], dim=1)
    moved = cam.clone()
    moved[:3, :3] = cam[:3, :3] @ turn.T
    moved[:3, 3:] = SCALE * (cam[:3, 3:] - moved[:3, :3] @ shift)
    return moved


def image(params, camera):
    backend = select_backend("reference", "cpu")
    K = torch.tensor([[30.0, 0.0, SIZE / 2], [0.0, 30.0, SIZE / 2], [0.0, 0.0, 1.0]], dtype=torch.float64)
    center = -camera[:3, :3].T @ camera[:3, 3]
    coeffs = torch.cat([params["features_dc"][:, None], params["features_rest"]], dim=1)
    colors = spherical_harmonics(3, params["means"] - center, coeffs, backend=backend) + 0.5
    activated = params["scales"].exp(), params["opacities"].sigmoid().squeeze(1)
    view = Camera(camera, K, SIZE, SIZE, 30.0)
    inputs = Inputs(params["means"], params["quats"], *activated, colors, view, render_depth=True)
    rendered = rasterize(inputs, backend=backend)
    assert rendered.depth is not None
    return rendered.colors, rendered.depth


def test_transformed_field_and_camera_give_the_same_image():
    params = gaussians()
    colors, depth = image(params, camera())
    moved_colors, moved_depth = image(similarity(params, transform(), SCALE), moved_camera())
    assert colors.std() > 0.1
    torch.testing.assert_close(moved_colors, colors, atol=1e-10, rtol=0)
    torch.testing.assert_close(moved_depth, SCALE * depth, atol=1e-10, rtol=0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_rotated_harmonics_are_the_rotated_function(degree):
    rest = gaussians(degree, n=4)["features_rest"]
    degree_0 = torch.zeros(4, 1, 3, dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(4, 3, dtype=torch.float64), dim=1)
    before = ReferenceBackend().spherical_harmonics(degree, directions, torch.cat([degree_0, rest], dim=1))
    rotated = rotate_spherical_harmonics(rest, rotation())
    after = ReferenceBackend().spherical_harmonics(
        degree, directions @ rotation().T, torch.cat([degree_0, rotated], dim=1)
    )
    torch.testing.assert_close(after, before, atol=1e-12, rtol=0)


@pytest.mark.parametrize("far", [5e5, -4e6, 3e12])
def test_survey_coordinates_are_moved_without_loss(far):
    means = far + 50 * torch.rand(100, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    means[3, 1] = torch.nan
    moved, offset = recentred(means)
    assert offset is not None
    assert moved.dtype == torch.float32
    whole = moved.double() + torch.tensor(offset, dtype=torch.float64)
    torch.testing.assert_close(whole, means, rtol=0, atol=abs(far) * 2.0**-53 + 2e-6, equal_nan=True)
    # A capture's own transform leads back to the origin before anything is rounded.
    back = torch.cat([torch.eye(3), -torch.tensor(offset, dtype=torch.float64)[:, None]], dim=1)
    assert torch.equal(similarity({**gaussians(n=100), "means": whole}, back, 1.0)["means"][4:].float(), moved[4:])


@pytest.mark.parametrize(
    "means", [torch.rand(50, 3) + 9, torch.full((5, 3), 9e9), torch.zeros(0, 3), torch.rand(9, 3) / 0]
)
def test_other_coordinates_stay(means):
    moved, offset = recentred(means.double())
    assert offset is None
    assert torch.equal(moved, means)


Y_DOWN, Z, Y = (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)


def ground(up, share):
    """Centres of which a share lies on the ground, and the others up to half its width above it."""
    axis = torch.nn.functional.normalize(torch.tensor(up), dim=0)
    side = torch.nn.functional.normalize(torch.linalg.cross(axis, torch.tensor([1.0, 0.2, 0.3])), dim=0)
    values = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0))
    heights = torch.where(torch.arange(4000) < share * 4000, 0.004 * values[:, 2], 0.05 + values[:, 2])
    turn = torch.stack([side, torch.linalg.cross(axis, side), axis])
    return torch.cat([2 * values[:, :2] - 1, heights[:, None]], dim=1) @ turn


@pytest.mark.parametrize(
    ("up", "share", "found"),
    [
        (Y_DOWN, 0.3, Y_DOWN),
        ((0.0, -0.9, 0.43), 0.3, (0.0, -0.9, 0.43)),  # a first camera that looks down
        (Z, 0.5, Z),
        (Y, 0.5, Y),
        (Z, 0.3, Y_DOWN),  # a wall may be as large
        ((1.0, 0.0, 0.0), 0.6, Y_DOWN),
        (Z, 0.0, Y_DOWN),
    ],
)
def test_up_is_that_of_the_ground_else_by_convention(up, share, found):
    direction, shown = upward(ground(up, share), Y_DOWN)
    assert torch.tensor(direction) @ torch.nn.functional.normalize(torch.tensor(found), dim=0) > 0.998
    assert shown == (up == found)
    assert upward(ground(Z, 0.5)[:50], Y_DOWN) == (Y_DOWN, False)
    both_sides = ground(Z, 0.5) * (-1.0) ** (torch.arange(4000)[:, None] // 4)
    assert upward(both_sides, Y_DOWN) == (Y_DOWN, False)
