"""The estimate of bits with gradients, against the entropy coder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from fields import random_field

from sundae_ns.io.pack import codecs as codec_room
from sundae_ns.io.pack.codecs import estimated_bits
from sundae_ns.io.pack.config import PackConfig
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene, write_fitted


def scene(n: int = 5000) -> PackedScene:
    g = torch.Generator().manual_seed(1)
    return PackedScene(random_field(n), {"a.weight": torch.randn(32, 32, 3, 3, generator=g), "a.bias": torch.zeros(32)})


@pytest.mark.parametrize("factor", [0.5, 1.0, 4.0])
def test_the_estimate_is_near_the_size(tmp_path: Path, factor: float) -> None:
    options = {name: factor * getattr(PackConfig(), name) for name in ("scale_step", "harmonics_step", "feature_step")}
    fitted, codecs = fit_scene(scene(), replace(PackConfig(), **options))
    found = estimated_bits(codecs, fitted.gaussians, fitted.head)
    sections = write_fitted(tmp_path / "a.sundae", fitted, codecs).sections
    assert set(found) == {*codecs.gaussians, "head"}
    for name, bits in found.items():
        assert 0.8 < float(bits) / (8 * sections[f"{name}/levels"]) < 1.4, name


def test_steps_against_the_gradient_make_a_smaller_file(tmp_path: Path) -> None:
    fitted, codecs = fit_scene(scene(), PackConfig())
    before = write_fitted(tmp_path / "a.sundae", fitted, codecs)
    leaves = {
        name: value.clone().requires_grad_() for name, value in fitted.gaussians.items() if name in codecs.gaussians
    }
    optimizer = torch.optim.Adam(leaves.values(), lr=0.003)
    for _ in range(30):
        optimizer.zero_grad()
        torch.stack(list(estimated_bits(codecs, leaves, {}).values())).sum().backward()
        optimizer.step()
    moved = {name: leaves.get(name, value).detach() for name, value in fitted.gaussians.items()}
    after = write_fitted(tmp_path / "b.sundae", replace(fitted, gaussians=moved), codecs)
    for name in ("features_rest", "features", "scales"):
        assert after.sections[f"{name}/levels"] < 0.999 * before.sections[f"{name}/levels"], name


def test_one_primitive_and_no_head() -> None:
    fitted, codecs = fit_scene(PackedScene(random_field(1)))
    assert all(torch.isfinite(bits) for bits in estimated_bits(codecs, fitted.gaussians, {}).values())


def test_runs_pay_for_their_mean_and_for_deviations() -> None:
    """Equal levels are cheaper than different ones, and still cheaper near zero."""
    equal, different = torch.full((67, 2), 9.0), 9.0 * torch.randn(67, 2, generator=torch.Generator().manual_seed(0))
    sizes = [float(codec_room._of_rows(levels)) for levels in (0.0 * equal, equal / 9, equal, different)]
    assert sizes[0] == 0.0
    assert 0 < sizes[1] < sizes[2] < sizes[3] / 4
