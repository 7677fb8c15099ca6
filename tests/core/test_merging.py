"""Covariances, overlap and merging."""

import math
from functools import partial

import pytest
import torch
from fields import normal_field

from sundae_ns.core.covariance import (
    covariances,
    entries_of,
    mean_projected_area,
    overlap,
    quaternions,
    rotation_matrices,
    scales_and_quaternions,
)
from sundae_ns.core.merging import merge

gaussians = partial(normal_field, n=12, features=5, dtype=torch.float64)


def covariance_of(params):
    return covariances(params["scales"].exp(), params["quats"])


def test_a_group_becomes_one_with_the_moments_of_the_mixture():
    params, w = gaussians(), torch.rand(12, dtype=torch.float64)
    label = torch.tensor([0, 0, 0, 0, 4, 4, 6, 7, 7, 7, 0, -1])
    found = merge(params, label, w)
    assert {name: value.shape for name, value in found.items()} == {k: (4, *v.shape[1:]) for k, v in params.items()}
    for place, owner in enumerate([0, 4, 6, 7]):
        group = label == owner
        weight = w[group] / w[group].sum()
        mean = weight @ params["means"][group]
        offset = params["means"][group] - mean
        spread = offset[:, :, None] * offset[:, None, :]
        S = (weight[:, None, None] * (covariance_of(params)[group] + spread)).sum(dim=0)
        torch.testing.assert_close(found["means"][place], mean)
        torch.testing.assert_close(covariance_of(found)[place], S)
        for name in ("features_dc", "features_rest", "features"):
            expected = torch.einsum("n,n...->...", weight, params[name][group])
            torch.testing.assert_close(found[name][place], expected)
    # 6 is alone.
    assert all(torch.equal(found[name][2], params[name][6]) for name in params)


def test_a_wall_of_small_primitives_absorbs_as_much_light_after_merging():
    # From afar, a Gaussian absorbs its optical depth times its projected area.
    params = gaussians(n=100)
    params["means"] = torch.cartesian_prod(*[torch.arange(10.0).double()] * 2, torch.zeros(1).double())
    params["scales"][:] = torch.tensor([0.4, 0.4, 1e-3]).double().log()
    params["quats"][:] = torch.tensor([1.0, 0, 0, 0]).double()
    params["opacities"][:] = -2.0
    found = merge(params, torch.zeros(100, dtype=torch.long), torch.ones(100))

    def absorption(p):
        depth = -torch.log1p(-p["opacities"].sigmoid().squeeze(1))
        return float((depth * mean_projected_area(p["scales"].exp())).sum())

    assert absorption(found) == pytest.approx(absorption(params))
    assert float(found["scales"].exp().min()) == pytest.approx(1e-3)


def test_merging_commutes_with_rotation_scale_and_shift():
    params, label, w = gaussians(), torch.tensor([0, 0, 0, 3, 3, 3, 6, 6, 6, 9, 9, -1]), torch.rand(12)
    R = rotation_matrices(torch.randn(1, 4, dtype=torch.float64))[0]
    moved = {**params, "means": 8 * params["means"] @ R.T + 100, "scales": params["scales"] + math.log(8)}
    moved["quats"] = quaternions(R @ rotation_matrices(params["quats"]))
    before, after = merge(params, label, w), merge(moved, label, w)
    torch.testing.assert_close(after["means"], 8 * before["means"] @ R.T + 100)
    torch.testing.assert_close(covariance_of(after), 64 * R @ covariance_of(before) @ R.T)
    torch.testing.assert_close(after["opacities"], before["opacities"])


def test_only_positive_weights_count_and_their_scale_does_not():
    params, label, w = gaussians(), torch.tensor([0] * 6 + [6] * 6), torch.rand(12, dtype=torch.float64)
    for none in (torch.zeros(12), torch.full((12,), torch.nan)):
        found = merge(params, label, none)
        assert all(torch.equal(found[name], params[name][[0, 6]]) for name in params)
    small, plain = merge(params, label, w * 1e-200), merge(params, label, w)
    assert all(torch.allclose(small[name], plain[name]) for name in params)
    w[[1, 7]] = 0
    expected = merge(params, label, w)
    for odd in (torch.nan, torch.inf, -1.0):
        w[[1, 7]] = odd
        found = merge(params, label, w)
        assert all(torch.equal(found[name], expected[name]) for name in params), odd


def test_extremes_stay_finite():
    params = {name: value.float() for name, value in gaussians().items()}
    params["scales"][0] = torch.tensor([1e-8, 1e3, 1.0]).log()
    params["quats"][1] = 0
    params["opacities"][:4] = torch.tensor([30.0, -30.0, 200.0, -200.0])[:, None]
    params["means"][5] = 1e18
    found = merge(params, torch.zeros(12, dtype=torch.long), torch.ones(12))
    assert all(value.isfinite().all() for value in found.values())
    assert found["opacities"].dtype == torch.float32
    assert float(found["opacities"].sigmoid().max()) <= 0.99 + 1e-6


def test_groups_that_overflow_or_vanish_are_unchanged():
    params = gaussians()
    params["scales"][0], params["scales"][6] = torch.tensor([0.0, 400.0, 0.0]), -500.0
    params["quats"][0] = torch.tensor([1.0, 0, 0, 0]).double()
    params["scales"][7:] = -500.0
    params["means"][6:] = 0
    found = merge(params, torch.tensor([0] * 3 + [3] * 3 + [6] * 6), torch.ones(12))
    assert all(torch.equal(found[name][[0, 2]], params[name][[0, 6]]) for name in params)
    assert all(value.isfinite().all() for value in found.values())
    assert not torch.equal(found["means"][1], params["means"][3])


def neighbours(params, indices, least_variance=0.0):
    rows = torch.arange(len(params["means"]))[:, None]
    return overlap(params["means"], entries_of(params), rows, torch.as_tensor(indices), least_variance)


def of_widths(means, widths, turn):
    values = {"means": means, "scales": widths, "quats": [turn] * len(means)}
    made = {name: torch.tensor(value, dtype=torch.float64) for name, value in values.items()}
    return {**made, "scales": made["scales"].log()}


def test_overlap_is_that_of_the_formula_and_1_with_itself():
    params = gaussians(n=200)
    S, means, other = covariance_of(params), params["means"], torch.arange(200).roll(1)
    found = neighbours(params, torch.stack([torch.arange(200), other], dim=1))
    torch.testing.assert_close(found[:, 0], torch.ones(200, dtype=torch.float64))
    assert float(found[:, 1].max()) < 1
    assert torch.equal(overlap(means, entries_of(params), torch.arange(200), other), found[:, 1])
    larger = {**params, "means": 16 * means, "scales": params["scales"] + math.log(16)}
    torch.testing.assert_close(neighbours(larger, other[:, None]), found[:, 1:])
    # With determinants and inverses of LAPACK.
    S = S + 0.3**2 * torch.eye(3)
    middle, offset = (S + S[other]) / 2, means - means[other]
    exponent = -torch.einsum("ni,nij,nj->n", offset, torch.linalg.inv(middle), offset) / 8
    ratio = (S.det() * S[other].det()) ** 0.25 / middle.det() ** 0.5
    torch.testing.assert_close(neighbours(params, other[:, None], 0.3**2)[:, 0], exponent.exp() * ratio)


def test_overlap_of_flat_ones_and_of_needles():
    assert neighbours(of_widths([[0, 0, 0]] * 2, [[1, 1, 0]] * 2, [1, 0, 0, 0]), [[1], [0]]).isfinite().all()
    # Pivots of crossed needles, turned away from the axes, are lost to rounding.
    needles = of_widths([[0, 0, 0]] * 2, [[1e6, 1e-6, 1e-6], [1e-6, 1e6, 1e-6]], [0.3, -0.5, 0.7, 0.2])
    found = neighbours(needles, [[0, 1], [1, 0]], 1e-12)
    assert found[:, 0].tolist() == [1, 1]
    assert found.isfinite().all()
    assert float(found[:, 1].max()) < 1e-3


def test_chunks_of_rows_give_the_same_result(monkeypatch):
    params, indices = gaussians(n=50), torch.randint(50, (50, 4))
    label, weight = torch.arange(50) // 5 * 5, torch.rand(50)
    whole, merged = neighbours(params, indices, 0.01), merge(params, label, weight)
    monkeypatch.setattr("sundae_ns.core.covariance.PAIRS", 30)
    monkeypatch.setattr("sundae_ns.core.covariance.ROWS", 7)
    assert torch.equal(neighbours(params, indices, 0.01), whole)
    again = merge(params, label, weight)
    assert all(torch.equal(again[name], merged[name]) for name in merged)


def test_quaternions_inverts_rotations_also_at_half_turns():
    turns = torch.cat([torch.eye(4), torch.randn(200, 4), torch.randn(200, 4) * torch.tensor([1e-4, 1, 1, 1])]).double()
    torch.testing.assert_close(rotation_matrices(quaternions(rotation_matrices(turns))), rotation_matrices(turns))
    assert torch.equal(rotation_matrices(torch.zeros(1, 4)), torch.eye(3)[None])


def test_scales_and_quaternions_invert_covariances_also_of_equal_axes_needles_and_single_points():
    generator = torch.Generator().manual_seed(0)
    scales = torch.rand(300, 3, generator=generator, dtype=torch.float64).pow(4)
    scales[:20] = 0.3
    scales[20:40, 1] = scales[20:40, 0]
    scales[40:60] *= torch.tensor([1e-9, 1.0, 1e-5])
    scales[60:80] = 0
    scales[80:100] *= 1e-100
    scales[100:120] *= 1e100
    turns = torch.randn(300, 4, generator=generator, dtype=torch.float64)
    turns[::7] = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    found, quats = scales_and_quaternions(covariances(scales, turns))
    largest = scales.amax(dim=1, keepdim=True).clamp_min(1e-300)
    torch.testing.assert_close(found / largest, scales.sort(dim=1).values / largest, rtol=0, atol=1e-7)
    back, first = (covariances(s / largest, q) for s, q in ((found, quats), (scales, turns)))
    torch.testing.assert_close(back, first, rtol=0, atol=1e-14)


def test_mean_projected_area_of_spheres_and_discs():
    found = mean_projected_area(torch.tensor([[2.0, 2, 2], [1, 1, 0], [3, 2, 1]]).double())
    assert float(found[0]) == pytest.approx(4)
    # For a disc it is half the area; the surface of a = 3, b = 2, c = 1 is 48.882.
    assert float(found[1]) == pytest.approx(0.5, rel=0.012)
    assert float(found[2]) == pytest.approx(48.882 / (4 * math.pi), rel=0.012)
