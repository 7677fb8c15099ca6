"""A field: its shapes, its initial values from points, and values beyond the finite numbers."""

import math
from functools import partial

import pytest
import torch
from fields import normal_field
from torch.nn.functional import normalize

from sundae_ns.core.errors import DataError
from sundae_ns.core.gaussians import SPLAT_NAMES, Gaussians, odd_shapes, sanitise, sh_degree_of, sh_to_rgb
from sundae_ns.scene.scene import from_points, initial_features

N = 40
gaussians = partial(normal_field, N, features=3)


@pytest.mark.parametrize("degree", range(5))
def test_fields_have_no_odd_shapes(degree):
    assert odd_shapes(normal_field(7, degree=degree, features=3)) == []
    assert sh_degree_of((degree + 1) ** 2 - 1) == degree


@pytest.mark.parametrize("name", [*(name for name in SPLAT_NAMES if name != "means"), "features"])
@pytest.mark.parametrize("shape", [(), (N,), (6, 3), (N, 3, 3, 1), (N, 7, 3), (N, 3, 4), (N, 35, 3)])
def test_an_odd_shape_is_named(name, shape):
    (found,) = odd_shapes(gaussians() | {name: torch.zeros(shape)})
    assert found.startswith(f"{name} has shape {list(shape)}; it must be [{N}, ")


def test_means_set_the_number_of_primitives():
    assert odd_shapes(gaussians() | {"means": torch.zeros(N, 4)}) == [f"means has shape [{N}, 4]; it must be [{N}, 3]"]
    assert len(odd_shapes(gaussians() | {"means": torch.zeros(6, 3)})) == len(SPLAT_NAMES)
    assert len(odd_shapes(gaussians() | {"means": torch.zeros(())})) == len(SPLAT_NAMES) + 1


def cloud(n=50):
    generator = torch.Generator().manual_seed(0)
    return torch.randn(n, 3, generator=generator), torch.rand(n, 3, generator=generator)


def test_one_primitive_per_point():
    points, rgb = cloud()
    params = from_points(points, rgb, sh_degree=3)
    assert params["features_rest"].shape == (50, 15, 3)
    assert all(len(value) == 50 and value.dtype == torch.float32 for value in params.values())
    assert torch.equal(params["means"], points)
    torch.testing.assert_close(sh_to_rgb(params["features_dc"]), rgb)
    assert not params["features_rest"].any()
    torch.testing.assert_close(params["opacities"].sigmoid(), torch.full((50, 1), 0.1))
    torch.testing.assert_close(params["quats"].norm(dim=1), torch.ones(50))
    # The width is the mean distance to three neighbours.
    expected = torch.cdist(points, points).sort(dim=1).values[:, 1:4].mean(dim=1)
    torch.testing.assert_close(params["scales"].exp(), expected[:, None].expand(50, 3))
    points[:10] = points[0]  # coincident ones have a finite width
    scales = from_points(points, rgb, sh_degree=0)["scales"]
    assert torch.isfinite(scales).all()
    torch.testing.assert_close(scales[:10], scales.min().expand(10, 3))


@pytest.mark.parametrize("n", [1, 2, 3, 10])
def test_few_points(n):
    points, rgb = cloud(n)
    for places in (points, points[:1].expand(n, 3)):
        params = from_points(places, rgb, sh_degree=1)
        assert all(len(value) == n and torch.isfinite(value).all() for value in params.values())


def test_points_that_are_not_finite_are_dropped():
    points, rgb = cloud()
    points[3, 1], points[7, 0], rgb[9, 2] = torch.nan, torch.inf, torch.nan
    params = from_points(points, rgb, sh_degree=1)
    assert torch.equal(params["means"], points[[i for i in range(50) if i not in (3, 7, 9)]])
    assert all(torch.isfinite(value).all() for value in params.values())
    for none in (points[:0], points * torch.nan):
        with pytest.raises(DataError, match="no finite point"):
            from_points(none, none, sh_degree=0)


@pytest.mark.parametrize("width", [1, 3, 13])
def test_features_begin_with_the_colour_and_differ(width):
    dc = torch.randn(200, 3)
    features = initial_features(dc, width)
    assert features.shape == (200, width)
    noise = features.clone()
    noise[:, : min(3, width)] -= dc[:, : min(3, width)]
    assert noise.abs().max() < 0.5
    assert (noise.std(dim=0) > 0.02).all()


def test_rotations_are_uniform():
    torch.manual_seed(0)
    quats = from_points(*torch.rand(2, 20000, 3), sh_degree=0)["quats"]
    torch.testing.assert_close(quats.T @ quats / 20000, torch.eye(4) / 4, atol=0.01, rtol=0)


def test_a_finite_field_is_returned_as_it_is():
    for given in (gaussians(), {name: value[:0] for name, value in gaussians().items()}):
        sanitised = sanitise(given)
        assert all(sanitised.gaussians[name] is value for name, value in given.items())
        assert (sanitised.clamped, sanitised.dropped, sanitised.summary()) == (False, 0, "")


def test_values_with_a_meaning_are_clamped():
    given, expected = gaussians(), gaussians()
    # 16 is the largest logit whose opacity is below 1 in float32; the square of a width of e^-43 is normal in it.
    for name, rows, value, clamped in (
        ("opacities", slice(10), math.inf, 16.0),
        ("opacities", slice(10, 12), -math.inf, -16.0),
        ("scales", slice(5, 20), -math.inf, -43.0),
        ("quats", slice(30, 33), 0.0, torch.tensor([1.0, 0.0, 0.0, 0.0])),
    ):
        given[name][rows, -1 if name == "scales" else slice(None)] = value
        expected[name][rows, -1 if name == "scales" else slice(None)] = clamped
    before = {name: value.clone() for name, value in given.items()}
    sanitised = sanitise(given)
    assert (sanitised.limits, sanitised.flat, sanitised.unrotated, sanitised.dropped) == (12, 15, 3, 0)
    kinds = "12 with opacity 0 or 1 and 15 with width 0 and 3 with rotation 0"
    assert sanitised.summary() == f"40 Gaussians: clamped {kinds} to finite values"
    for name, value in expected.items():
        assert torch.equal(sanitised.gaussians[name], value), name
        assert torch.equal(given[name], before[name]), name


def test_flat_primitives_of_a_tiny_scene_are_as_narrow_as_its_narrowest():
    given = gaussians()
    given["scales"] -= 60
    given["scales"][3, 0] = -math.inf
    assert sanitise(given).gaussians["scales"][3, 0] == given["scales"][torch.arange(N) != 3].min()


@pytest.mark.parametrize("size", [1e-30, 1e-15, 1e25])
def test_quaternions_of_any_length_keep_their_rotation(size):
    given = gaussians()
    turned = normalize(torch.tensor([0.5, -0.3, 0.2, 0.7]), dim=0)
    given["quats"][7] = size * turned
    sanitised = sanitise(given)
    torch.testing.assert_close(normalize(sanitised.gaussians["quats"][7], dim=0), turned)
    assert not sanitised.clamped


UNBOUNDED = ("means", "quats", "features_dc", "features_rest", "features")
UNUSABLE = [("scales", math.inf), *((name, math.nan) for name in gaussians())]
UNUSABLE += [(name, value) for name in UNBOUNDED for value in (math.inf, -math.inf)]


@pytest.mark.parametrize(("name", "value"), UNUSABLE)
def test_primitives_without_a_meaning_are_left_out(name, value):
    given = gaussians()
    given[name][4].view(-1)[0] = value
    given["opacities"][8] = math.inf
    sanitised = sanitise(Gaussians(given, "logits"))
    assert sanitised.gaussians.encoding == "logits"
    assert (sanitised.dropped, sanitised.limits) == (1, 1)
    assert (~sanitised.mask).nonzero().flatten().tolist() == [4]
    assert sanitised.gaussians.num_gaussians == N - 1
    assert sanitised.summary().endswith("finite values, dropped 1 that were not finite (NaN or infinite)")
