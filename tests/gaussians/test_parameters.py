"""Shapes of a field, and degrees of its harmonics."""

from __future__ import annotations

import pytest
import torch

from sundae_ns.gaussians import SPLAT_NAMES, from_points
from sundae_ns.gaussians.parameters import MAX_SH_DEGREE, odd_shapes, sh_degree_of


@pytest.mark.parametrize("degree", range(MAX_SH_DEGREE + 1))
def test_fields_have_no_odd_shapes(degree: int) -> None:
    points = torch.rand(7, 3)
    assert odd_shapes(from_points(points, points, sh_degree=degree, num_features=3)) == []
    assert sh_degree_of((degree + 1) ** 2 - 1) == degree


@pytest.mark.parametrize("name", SPLAT_NAMES)
@pytest.mark.parametrize("shape", [(), (7,), (6, 3), (7, 9), (7, 3, 3, 1), (7, 7, 3), (7, 3, 4), (7, 35, 3)])
def test_odd_shapes_are_named(name: str, shape: tuple[int, ...]) -> None:
    points = torch.rand(7, 3)
    field = from_points(points, points, sh_degree=1, num_features=0)
    field[name] = torch.zeros(shape)
    odd = odd_shapes(field)
    # All others are odd beside another number of means.
    assert len(odd) == (len(SPLAT_NAMES) - (shape == (6, 3)) if name == "means" and shape[:1] != (7,) else 1)
    if not (name == "means" and shape == (6, 3)):
        assert any(text.startswith(f"{name} has shape {list(shape)}; it must be [") for text in odd)
    assert sh_degree_of(7) is None
