"""Shapes of a field, and SH degrees."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from sundae_ns.gaussians import from_points
from sundae_ns.gaussians.gaussians import MAX_SH_DEGREE, SPLAT_NAMES, odd_shapes, sh_degree_of


def field(degree: int) -> dict[str, Tensor]:
    points = torch.rand(7, 3)
    return from_points(points, points, sh_degree=degree, num_features=3)


@pytest.mark.parametrize("degree", range(MAX_SH_DEGREE + 1))
def test_fields_have_no_odd_shapes(degree: int) -> None:
    assert odd_shapes(field(degree)) == []
    assert sh_degree_of((degree + 1) ** 2 - 1) == degree


@pytest.mark.parametrize("name", [name for name in SPLAT_NAMES if name != "means"])
@pytest.mark.parametrize("shape", [(), (7,), (6, 3), (7, 9), (7, 3, 3, 1), (7, 7, 3), (7, 3, 4), (7, 35, 3)])
def test_an_odd_shape_is_named(name: str, shape: tuple[int, ...]) -> None:
    (found,) = odd_shapes(field(1) | {name: torch.zeros(shape)})
    assert found.startswith(f"{name} has shape {list(shape)}; it must be [7, ")


def test_means_set_the_number_of_primitives() -> None:
    assert odd_shapes(field(1) | {"means": torch.zeros(7, 4)}) == ["means has shape [7, 4]; it must be [7, 3]"]
    assert [line.partition(" ")[0] for line in odd_shapes(field(1) | {"means": torch.zeros(6, 3)})] == [
        *("scales", "quats", "features_dc", "opacities", "features_rest")
    ]
    assert len(odd_shapes(field(1) | {"means": torch.zeros(())})) == len(SPLAT_NAMES)
