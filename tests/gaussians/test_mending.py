"""Values beyond the finite numbers: those with a meaning become finite, and only primitives without one go."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sundae_ns.gaussians import from_points, mend
from sundae_ns.gaussians.covariance import rotation_matrices
from sundae_ns.gaussians.gaussians import Field
from sundae_ns.pruning import PruneRule, prune_field
from sundae_ns.pruning.decision import FieldPruner

N = 40


def field() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(N, 3, generator=generator)
    return from_points(points, points, sh_degree=1, num_features=3, generator=generator)


def test_a_finite_field_is_returned_as_it_is() -> None:
    given = field()
    mended = mend(given)
    assert all(mended.field[name] is value for name, value in given.items())
    assert not mended.clamped
    assert mended.dropped == 0
    assert mended.summary() == ""


def test_values_with_a_meaning_are_clamped() -> None:
    given = field()
    given["opacities"][:10], given["opacities"][10:12] = math.inf, -math.inf
    given["scales"][5:20, 2] = -math.inf
    given["quats"][30:33] = 0
    before = {name: value.clone() for name, value in given.items()}
    mended = mend(given)
    assert (mended.limits, mended.flat, mended.unrotated, mended.dropped) == (12, 15, 3, 0)
    assert mended.summary() == (
        "40 primitives: clamped 12 with opacity 0 or 1 and 15 with width 0 and 3 with rotation 0 to finite values"
    )
    found = mended.field
    assert all(value.isfinite().all() for value in found.values())
    opacities = found["opacities"].sigmoid()
    assert (opacities[:10] > 1 - 1e-6).all()
    assert (opacities[:10] < 1).all()  # with a finite optical depth
    assert (opacities[10:12] < 1e-6).all()
    assert (found["scales"][5:20, 2].exp() < 1e-18).all()
    assert torch.equal(rotation_matrices(found["quats"][30:33]), torch.eye(3).expand(3, 3, 3))
    # All else stays, and so does what was given.
    assert torch.equal(found["opacities"][12:], given["opacities"][12:])
    assert torch.equal(found["scales"][:, :2], given["scales"][:, :2])
    assert torch.equal(found["means"], given["means"])
    assert all(torch.equal(given[name], before[name]) for name in given)


def test_flat_primitives_of_a_tiny_scene_are_as_narrow_as_its_narrowest() -> None:
    given = field()
    given["scales"] -= 60
    given["scales"][3, 0] = -math.inf
    narrowest = given["scales"][torch.arange(N) != 3].min()
    assert mend(given).field["scales"][3, 0] == narrowest


@pytest.mark.parametrize("size", [1e-30, 1e-15, 1e25])
def test_quaternions_of_any_length_keep_their_rotation(size: float) -> None:
    given = field()
    turned = torch.nn.functional.normalize(torch.tensor([0.5, -0.3, 0.2, 0.7]), dim=0)
    given["quats"][7] = size * turned
    mended = mend(given)
    torch.testing.assert_close(torch.nn.functional.normalize(mended.field["quats"][7], dim=0), turned)
    assert not mended.clamped


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, math.nan) for name in field()),
        *(
            (name, sign * math.inf)
            for name in ("means", "features_dc", "features_rest", "features")
            for sign in (1, -1)
        ),
        ("scales", math.inf),
        ("quats", math.inf),
        ("quats", -math.inf),
    ],
)
def test_primitives_without_a_meaning_are_left_out(name: str, value: float) -> None:
    given = field()
    given[name][4].view(-1)[0] = value
    given["opacities"][8] = math.inf
    mended = mend(Field(given, "logits"))
    assert mended.field.encoding == "logits"
    assert (mended.dropped, mended.limits) == (1, 1)
    assert (~mended.mask).nonzero().flatten().tolist() == [4]
    assert mended.field.num_primitives == N - 1
    assert mended.summary().endswith("finite values, dropped 1 that were not finite (NaN or infinite)")


def test_a_field_without_primitives() -> None:
    assert mend({name: value[:0] for name, value in field().items()}).field.num_primitives == 0


@pytest.mark.parametrize("redistribution", ["none", "merge"])
@pytest.mark.parametrize("count", [10, N])
def test_a_prune_of_opaque_and_flat_primitives_is_exact_and_finite(redistribution: str, count: int) -> None:
    given = field()
    given["opacities"][:], given["scales"][:, 1] = math.inf, -math.inf
    rule = PruneRule(redistribution=redistribution)  # type: ignore[arg-type]
    contribution = torch.linspace(0, 1, N)
    found = prune_field(given, rule, count, contribution)
    assert found.decision.dropped_nonfinite == 0
    assert found.field.num_primitives == count
    assert all(value.isfinite().all() for value in found.field.values())


def test_training_keeps_them_too() -> None:
    params = {name: torch.nn.Parameter(value) for name, value in field().items()}
    with torch.no_grad():
        params["opacities"][:6], params["means"][9] = math.inf, math.nan
    optimizers = {name: torch.optim.Adam([value]) for name, value in params.items()}
    assert FieldPruner(params, optimizers).drop_nonfinite() == 1
    assert len(params["means"]) == N - 1
    assert (params["opacities"][:6].sigmoid() > 1 - 1e-6).all()
    assert all(value.isfinite().all() for value in params.values())
    assert optimizers["opacities"].param_groups[0]["params"][0] is params["opacities"]
