"""Our kernels in gsplat's pipeline: the CUDA source, compiled for the CPU, against the reference in float64."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sundae_ns.rasterize import gsplat_backend, gsplat_kernels, interface
from sundae_ns.rasterize.gsplat_backend import RecordableGsplat
from sundae_ns.rasterize.gsplat_kernels import TILE, Capacity, GsplatLists, Splats, blend, tile_lists
from sundae_ns.rasterize.interface import harmonic_colors, select_backend
from sundae_ns.rasterize.reference import Projection, composite


@pytest.fixture(autouse=True)
def on_cpu(load_on_cpu, monkeypatch):
    monkeypatch.setattr(gsplat_kernels, "load_kernels", load_on_cpu)
    monkeypatch.setattr(gsplat_kernels, "LANES", 1)
    for module in (gsplat_backend, interface):
        monkeypatch.setattr(module, "check_kernels_take", lambda _: None)


def test_kernels_compile_for_gpus(compile_for_gpu, monkeypatch):
    monkeypatch.setattr(gsplat_kernels, "LANES", 32)
    for dtype in (torch.int16, torch.int32):
        compile_for_gpu("tiles.cu", "sm_75", gsplat_kernels.listing_options(dtype))
    compile_for_gpu("colors.cu", "sm_90", gsplat_kernels.COLOR_OPTIONS)
    for architecture, channels, absgrad in (("sm_75", 3, True), ("sm_90", 16, False), ("sm_90", 32, False)):
        compile_for_gpu("blending.cu", architecture, gsplat_kernels.blending_options(channels, absgrad=absgrad))


def ellipses(n, width, height, *, largest=4.0, power=1, opacity=1.0, channels=3, seed=0):
    """Footprints in and around an image, float64: of all shapes, some opaque, some too faint to be blended.

    Variances of their axes are up to ``10 ** largest`` square pixels; a higher ``power`` makes most of them faint.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator).double()

    angle, sides = uniform(n) * 6.3, 10 ** (uniform(2, n) * (largest + 1) - 1)
    c, s = angle.cos(), angle.sin()
    xx, yy = sides[0] * c * c + sides[1] * s * s + 0.3, sides[0] * s * s + sides[1] * c * c + 0.3
    xy = (sides[0] - sides[1]) * c * s
    opacities = (uniform(n) * 1.3).clamp(max=1) ** power * opacity
    opacities[::13] = 1e-3
    return {
        "means2d": (uniform(n, 2) * 1.4 - 0.2) * torch.tensor([width, height]),
        "covariances": torch.stack([xx, xy, yy], dim=1),
        "conics": torch.stack([yy, -xy, xx], dim=1) / (xx * yy - xy * xy)[:, None],
        "opacities": opacities,
        "depths": uniform(n) + 0.1,
        "colors": uniform(n, channels),
    }


def gaussians(n, width, height, *, largest=4.0, seed=0):
    """Ellipses in float32, up to needles across the image, with radii; some are culled, and some equally deep."""
    made = ellipses(n, width, height, largest=largest, power=3, seed=seed)
    radii = (3 * (made["covariances"][:, 0] + made["covariances"][:, 2]).sqrt()).ceil().int()
    radii[::17] = 0
    made["depths"][1::9] = made["depths"][0]
    fields = {name: made[name].float() for name in ("means2d", "conics", "opacities", "depths")}
    return {**fields, "radii": radii}


def in_square(primitives, column, row, columns, rows):
    """Whether gsplat's square of each Gaussian contains a tile ``[N]``."""
    radii = primitives["radii"].float().view(len(primitives["depths"]), -1).expand(-1, 2) / TILE
    low = (primitives["means2d"] / TILE - radii).floor().clamp(min=0).minimum(torch.tensor([columns, rows]))
    high = (primitives["means2d"] / TILE + radii).ceil().clamp(min=0).minimum(torch.tensor([columns, rows]))
    at = torch.tensor([column, row])
    return (radii > 0).all(dim=1) & (low <= at).all(dim=1) & (high > at).all(dim=1)


def most_alpha(primitives, column, row, width, height):
    """Largest alpha of each Gaussian over the pixels of a tile, float64 ``[N]``."""
    ys, xs = torch.meshgrid(
        torch.arange(row * TILE, min(row * TILE + TILE, height)) + 0.5,
        torch.arange(column * TILE, min(column * TILE + TILE, width)) + 0.5,
        indexing="ij",
    )
    dx = xs.reshape(1, -1).double() - primitives["means2d"][:, :1].double()
    dy = ys.reshape(1, -1).double() - primitives["means2d"][:, 1:].double()
    a, b, c = primitives["conics"].double().T[..., None]
    exponents = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    return (primitives["opacities"][:, None].double() * (-exponents).exp()).amax(dim=1)


def by_tile(primitives, width, height, capacity=None):
    splats = Splats(**{name: value[None] for name, value in primitives.items()})
    lists = tile_lists(splats, width, height, capacity=capacity or Capacity())
    ends = [*lists.starts.flatten()[1:].tolist(), len(lists.gaussians)]
    starts = lists.starts.flatten().tolist()
    return [lists.gaussians[start:end].long() for start, end in zip(starts, ends, strict=True)]


@pytest.mark.parametrize(("width", "height"), [(150, 100), (1, 1), (400, 37), (20, 700)])
def test_all_blended_primitives_are_listed_and_hardly_any_others(width, height):
    primitives = gaussians(300, width, height, largest=5.5)
    columns, rows = -(-width // TILE), -(-height // TILE)
    needed = listed = squares = 0
    for tile, found in enumerate(by_tile(primitives, width, height)):
        row, column = divmod(tile, columns)
        square = in_square(primitives, column, row, columns, rows)
        blended = square & (most_alpha(primitives, column, row, width, height) >= 1 / 255)
        there = torch.zeros_like(square).index_fill(0, found, True)
        assert not (blended & ~there).any()
        assert not (there & ~square).any()
        order = primitives["depths"][found] * 1000 + found  # by depth, and ties by index
        assert (primitives["depths"][found].diff() >= 0).all()
        assert (order.diff()[primitives["depths"][found].diff() == 0] > 0).all()
        needed, listed, squares = needed + int(blended.sum()), listed + len(found), squares + int(square.sum())
    assert listed <= 1.02 * needed + 2
    if columns * rows > 1:  # gsplat's own lists would fail this test
        assert squares > 2 * listed


@given(seed=st.integers(0, 10**6), largest=st.sampled_from([1.0, 4.0, 7.0]), shift=st.sampled_from([0.0, 3000.0]))
def test_needles_far_away_are_not_dropped(seed, largest, shift):
    width, height = 70, 50
    primitives = gaussians(40, width, height, largest=largest, seed=seed)
    primitives["means2d"] += shift * torch.randn(40, 2, generator=torch.Generator().manual_seed(seed))
    primitives["radii"][:] = 10000
    for tile, found in enumerate(by_tile(primitives, width, height)):
        row, column = divmod(tile, 5)
        # gsplat sums the exponent in float32: Gaussians that are visible by rounding may be listed, visible ones must
        # be.
        blended = most_alpha(primitives, column, row, width, height) >= 1.01 / 255
        assert not (blended & ~torch.zeros(40, dtype=torch.bool).index_fill(0, found, True)).any()


def test_least_exponent_between_two_tiles():
    """A faint needle across the gap between two tiles reaches the tile on the far side of the border."""
    primitives = gaussians(1, 64, 64)
    c, s = math.cos(1.7074472511921694), math.sin(1.7074472511921694)
    xx, xy, yy = 625.1582971 * c * c + 0.3, 625.1582971 * c * s, 625.1582971 * s * s + 0.3
    primitives["conics"][0] = torch.tensor([yy, -xy, xx], dtype=torch.float64) / (xx * yy - xy * xy)
    primitives["means2d"][0] = torch.tensor([32.12918686614097, 32.5 - 0.9142656220370688])
    primitives["opacities"][0], primitives["radii"][0] = math.exp(0.1) / 255, 100
    alphas = [float(most_alpha(primitives, column, 2, 64, 64)) for column in range(4)]
    assert [alpha >= 1 / 255 for alpha in alphas] == [False, True, False, False]
    assert len(by_tile(primitives, 64, 64)[2 * 4 + 1]) == 1


def test_nan_is_left_to_gsplat():
    primitives = gaussians(20, 64, 64)
    primitives["radii"][:] = 100
    primitives["conics"][3], primitives["opacities"][5], primitives["conics"][7] = torch.nan, torch.nan, 0.0
    for found in by_tile(primitives, 64, 64):
        assert {3, 5, 7} <= set(found.tolist())


def test_radii_per_axis():
    primitives = gaussians(200, 150, 100)
    per_axis = {name: torch.stack(3 * [value], dim=1)[:, 0] for name, value in primitives.items()}  # not contiguous
    per_axis["radii"] = primitives["radii"][:, None].repeat(1, 3)[:, :2]
    one, other = (by_tile(rows, 150, 100) for rows in (per_axis, primitives))
    assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))
    per_axis["radii"][:, 1] = per_axis["radii"][:, 1] // 3
    for tile, found in enumerate(by_tile(per_axis, 150, 100)):
        assert in_square(per_axis, tile % 10, tile // 10, 10, 7)[found].all()


def test_capacity_keeps_the_lists_and_reports_the_number_of_pairs():
    primitives, capacity = gaussians(200, 150, 100), Capacity()
    exact = by_tile(primitives, 150, 100, capacity)
    (needed,) = capacity.needed
    assert int(needed) == sum(map(len, exact))
    assert needed.untyped_storage().nbytes() == 8  # the sums of all Gaussians are not kept
    for spare in (0, 1000):
        *found, below = by_tile(primitives, 150, 100, Capacity(int(needed) + spare))[: len(exact) + 1]
        assert all(torch.equal(a, b) for a, b in zip(found, exact, strict=True))
        assert len(below) == spare  # a tile below the image takes the unused pairs
    short = Capacity(int(needed) - 5)
    by_tile(primitives, 150, 100, short)
    assert int(short.needed[0]) == int(needed)


def test_more_tiles_than_16_bits_count():
    primitives = gaussians(5, 30, 30)
    primitives["means2d"] = torch.tensor([[3275.0 * TILE, 5.0]] * 5)
    found = by_tile(primitives, 3300 * TILE, 10 * TILE)
    assert {tile % 3300 // 100 for tile, list_ in enumerate(found) if len(list_)} == {32}


NAMES = ("means2d", "conics", "colors", "opacities")


def every_tile(primitives, width, height, spare):
    """Every Gaussian in every tile, by depth, and a tile below the image with ``spare`` pairs."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    order = primitives["depths"].argsort(stable=True).int()
    starts = torch.arange(columns * (rows + (spare > 0)), dtype=torch.int32).clamp(max=columns * rows) * len(order)
    pairs = torch.cat([order.repeat(columns * rows), torch.zeros(spare, dtype=torch.int32)])
    return GsplatLists(width, height, starts.view(1, -1, columns), pairs)


def expected(primitives, leaves, width, height, absgrad):
    n = len(primitives["depths"])
    radii = torch.full((n,), 10_000, dtype=torch.int32)  # no squares: every tile
    compensations, covariances = torch.ones(n).double(), primitives["covariances"]
    conics, depths = leaves["conics"][0], primitives["depths"]
    projection = Projection(primitives["means2d"], covariances, conics, depths, compensations, radii)
    blended = leaves["opacities"][0], leaves["colors"][0]
    return composite(leaves["means2d"], projection, *blended, (width, height), absgrad=absgrad)


def leaves_of(primitives, dtype):
    return {name: primitives[name][None].to(dtype, copy=True).requires_grad_() for name in NAMES}


@pytest.mark.parametrize(
    ("n", "channels", "width", "height", "absgrad"),
    [
        (60, 3, 40, 23, False),
        (60, 3, 16, 16, True),
        (400, 16, 33, 17, False),  # more than a batch, and pixels that are finished early
        (20, 35, 20, 20, True),
        (1, 1, 1, 1, False),
    ],
)
@pytest.mark.parametrize("opacity", [0.3, 1.0], ids=["faint", "opaque"])
def test_image_and_gradients_match_the_reference(n, channels, width, height, absgrad, opacity):
    primitives = ellipses(n, width, height, largest=2.0, channels=channels, opacity=opacity)
    ours, exact = leaves_of(primitives, torch.float32), leaves_of(primitives, torch.float64)
    lists = every_tile(primitives, width, height, spare=7 if absgrad else 0)
    image, alpha = blend(*ours.values(), lists, absgrad)
    other_image, other_alpha = expected(primitives, exact, width, height, absgrad)
    assert image.shape == (1, height, width, channels)
    torch.testing.assert_close(image[0].double(), other_image, rtol=0, atol=2e-5)
    torch.testing.assert_close(alpha[0].double(), other_alpha, rtol=0, atol=2e-5)
    weights = torch.randn(height, width, channels + 1, dtype=torch.float64)
    for images, alphas in ((image[0], alpha[0]), (other_image, other_alpha)):
        (torch.cat([images, alphas], dim=-1) * weights).sum().backward()
    pairs = [(ours[name].grad, exact[name].grad) for name in NAMES]
    if absgrad:
        pairs.append((ours["means2d"].absgrad, exact["means2d"].absgrad))
    for found, truth in pairs:
        assert (found - truth).norm() <= 1e-4 * truth.norm() + 1e-6


def test_an_empty_list_leaves_the_background():
    ours = leaves_of(ellipses(5, 20, 20, largest=2.0), torch.float32)
    lists = GsplatLists(20, 20, torch.zeros(1, 2, 2, dtype=torch.int32), torch.zeros(0, dtype=torch.int32))
    image, alpha = blend(*ours.values(), lists, False)
    assert not image.any()
    assert not alpha.any()
    (image.sum() + alpha.sum()).backward()
    assert all(not leaf.grad.any() for leaf in ours.values() if leaf.grad is not None)


def colors_inputs():
    """Centres, a camera's centre, and coefficients of degree 4.

    Some colours are negative, and one centre is the camera's.
    """
    means, center = torch.randn(300, 3) * 3, torch.tensor([0.5, -1.0, 2.0])
    means[7] = center
    return means, center, torch.randn(300, 3) * 2, torch.randn(300, 24, 3)


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("each", [False, True], ids=["one place", "a place each"])
def test_colors_and_gradients_match_the_reference(degree, each):
    means, center, dc, rest = colors_inputs()
    center = center + torch.randn(300, 3) if each else center
    rest = rest[:, : max((degree + 1) ** 2 - 1, 8)]  # some coefficients are of higher degrees
    weights = torch.randn(300, 3)
    ours = [value.clone().requires_grad_() for value in (means, center, dc, rest)]
    exact = [value.double().requires_grad_() for value in (means, center, dc, rest)]
    found = harmonic_colors(degree, *ours, backend=RecordableGsplat(Capacity()))
    expected = harmonic_colors(degree, *exact, backend=select_backend("reference", "cpu"))
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=1e-5)
    assert 0.1 < (found == 0).float().mean() < 0.9
    (found * weights).sum().backward()
    (expected * weights).sum().backward()
    for one, other in zip(ours, exact, strict=True):
        # The constant harmonic does not depend on the place.
        gradient = torch.zeros_like(other) if other.grad is None else other.grad
        torch.testing.assert_close(one.grad.double(), gradient, rtol=1e-4, atol=5e-5)
    fixed = [value.detach().requires_grad_() for value in ours[::2]]
    colors = harmonic_colors(degree, fixed[0], center, fixed[1], rest, backend=RecordableGsplat(Capacity()))
    (colors * weights).sum().backward()
    assert all(torch.equal(one.grad, other.grad) for one, other in zip(fixed, ours[::2], strict=True))
