"""Initial parameters of a field: scales from neighbours, colours from points, all finite."""

from __future__ import annotations

import pytest
import torch

from sundae_ns.errors import DataError
from sundae_ns.gaussians import from_points, initial_features, random_points
from sundae_ns.gaussians.gaussians import SPLAT_NAMES, sh_to_rgb
from sundae_ns.gaussians.initialization import INITIAL_OPACITY, random_quaternions


def cloud(n: int = 50) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(n, 3, generator=generator), torch.rand(n, 3, generator=generator)


def test_one_primitive_per_point() -> None:
    points, rgb = cloud()
    params = from_points(points, rgb, sh_degree=3, num_features=5)
    assert tuple(params) == (*SPLAT_NAMES[:3], "features_dc", "features_rest", "opacities", "features")
    shapes = {name: tuple(value.shape[1:]) for name, value in params.items()}
    assert shapes == {
        "means": (3,),
        "scales": (3,),
        "quats": (4,),
        "features_dc": (3,),
        "features_rest": (15, 3),
        "opacities": (1,),
        "features": (5,),
    }
    assert all(len(value) == 50 and value.dtype == torch.float32 for value in params.values())
    assert torch.equal(params["means"], points)
    torch.testing.assert_close(sh_to_rgb(params["features_dc"]), rgb)
    assert not params["features_rest"].any()
    torch.testing.assert_close(params["opacities"].sigmoid(), torch.full((50, 1), INITIAL_OPACITY))
    torch.testing.assert_close(params["quats"].norm(dim=1), torch.ones(50))


def test_width_is_the_mean_distance_to_three_neighbours() -> None:
    points, rgb = cloud()
    expected = torch.cdist(points, points).sort(dim=1).values[:, 1:4].mean(dim=1)
    scales = from_points(points, rgb, sh_degree=0, num_features=0)["scales"].exp()
    torch.testing.assert_close(scales, expected[:, None].expand(50, 3))


@pytest.mark.parametrize("n", [1, 2, 3])
def test_few_points(n: int) -> None:
    points, rgb = cloud(n)
    params = from_points(points, rgb, sh_degree=1, num_features=2)
    assert all(len(value) == n and torch.isfinite(value).all() for value in params.values())


def test_coincident_points_get_a_finite_width() -> None:
    points, rgb = cloud()
    points[:10] = points[0]
    scales = from_points(points, rgb, sh_degree=0, num_features=0)["scales"]
    assert torch.isfinite(scales).all()
    torch.testing.assert_close(scales[:10], scales.min().expand(10, 3))
    same = from_points(points[:10], rgb[:10], sh_degree=0, num_features=0)["scales"]
    assert torch.isfinite(same).all()


def test_points_that_are_not_finite_are_dropped() -> None:
    points, rgb = cloud()
    points[3, 1], points[7, 0], rgb[9, 2] = torch.nan, torch.inf, torch.nan
    params = from_points(points, rgb, sh_degree=1, num_features=1)
    good = [i for i in range(50) if i not in (3, 7, 9)]
    assert torch.equal(params["means"], points[good])
    assert all(torch.isfinite(value).all() for value in params.values())


@pytest.mark.parametrize("points", [torch.zeros(0, 3), torch.full((4, 3), torch.nan)])
def test_no_finite_point(points: torch.Tensor) -> None:
    with pytest.raises(DataError, match="no finite point") as caught:
        from_points(points, torch.zeros_like(points), sh_degree=0, num_features=0)
    assert "\n" not in str(caught.value)


def test_no_features_for_zero_channels() -> None:
    assert "features" not in from_points(*cloud(), sh_degree=0, num_features=0)


@pytest.mark.parametrize("width", [1, 3, 13])
def test_features_begin_with_the_colour_and_differ(width: int) -> None:
    dc = torch.randn(200, 3)
    features = initial_features(dc, width)
    assert features.shape == (200, width)
    noise = features.clone()
    noise[:, : min(3, width)] -= dc[:, : min(3, width)]
    assert noise.abs().max() < 0.5
    assert (noise.std(dim=0) > 0.02).all()


def test_equal_generators_give_equal_fields() -> None:
    first, second, other = (
        from_points(*cloud(), sh_degree=0, num_features=4, generator=torch.Generator().manual_seed(seed))
        for seed in (1, 1, 2)
    )
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert not torch.equal(first["quats"], other["quats"])
    assert not torch.equal(first["features"], other["features"])


def test_rotations_are_uniform() -> None:
    quats = random_quaternions(20000, torch.Generator().manual_seed(0))
    torch.testing.assert_close(quats.T @ quats / 20000, torch.eye(4) / 4, atol=0.01, rtol=0)


def test_random_points_fill_the_cube() -> None:
    points, rgb = random_points(5000, 10.0, torch.Generator().manual_seed(0))
    assert points.abs().max() <= 5
    assert points.abs().max() > 4.9
    assert points.mean(dim=0).abs().max() < 0.2
    assert rgb.shape == (5000, 3)
    assert 0 <= rgb.min() < rgb.max() <= 1
