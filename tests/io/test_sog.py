"""Files of .sog, decoded by the format's public description."""

from __future__ import annotations

import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from sundae_ns.io.coordinates import scene_order
from sundae_ns.io.sog import codebook, kmeans, palette, write_sog
from sundae_ns.scene.initialization import from_points


def gaussians(n: int = 150, degree: int = 3) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    points = 4 * torch.rand(n, 3, generator=generator) - 2
    made = from_points(points, points / 4 + 0.5, sh_degree=degree, num_features=3, generator=generator)
    made["quats"] = torch.randn(n, 4, generator=generator)
    made["scales"] = -5 + torch.randn(n, 3, generator=generator)
    made["features_dc"] = torch.randn(n, 3, generator=generator)
    made["features_rest"] = 0.1 * torch.randn(made["features_rest"].shape, generator=generator)
    made["opacities"] = 2 * torch.randn(n, 1, generator=generator)
    made["opacities"][:3] = -20  # opacity level 0: colours must survive
    return made


def read(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[np.float64]]]:
    """``meta.json``, and the Gaussians as sections 3.1 to 3.5 of the description decode them."""
    with zipfile.ZipFile(path) as bundle:
        meta = json.loads(bundle.read("meta.json"))

        def pixels(entry: str, number: int = 0) -> NDArray[np.int64]:
            with bundle.open(meta[entry]["files"][number]) as file:
                return np.asarray(Image.open(file).convert("RGBA"), dtype=np.int64)

        n = meta["count"]
        level = [pixels("means", i).reshape(-1, 4)[:n, :3] for i in (0, 1)]
        low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
        bent = low + (high - low) * (level[0] + 256 * level[1]) / 65535
        quats = pixels("quats").reshape(-1, 4)[:n]
        three = (quats[:, :3] / 255 - 0.5) * 2 / math.sqrt(2)
        rotations = np.empty((n, 4))
        for i in range(n):
            rotations[i] = np.insert(three[i], quats[i, 3] - 252, np.sqrt(1 - (three[i] ** 2).sum()))
        colors = pixels("sh0").reshape(-1, 4)[:n]
        found = {
            "means": np.sign(bent) * np.expm1(np.abs(bent)),
            "quats": rotations,
            "scales": np.array(meta["scales"]["codebook"])[pixels("scales").reshape(-1, 4)[:n, :3]],
            "features_dc": np.array(meta["sh0"]["codebook"])[colors[:, :3]],
            "alphas": colors[:, 3:] / 255,
        }
        if "shN" in meta:
            count = (meta["shN"]["bands"] + 1) ** 2 - 1
            labels = pixels("shN", 1).reshape(-1, 4)[:n]
            index = labels[:, 0] + 256 * labels[:, 1]
            assert index.max() < meta["shN"]["count"]
            rows = pixels("shN")
            assert rows.shape[1] == 64 * count
            column = (index % 64)[:, None] * count + np.arange(count)
            found["features_rest"] = np.array(meta["shN"]["codebook"])[rows[(index // 64)[:, None], column, :3]]
    return meta, found


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_values_come_back(tmp_path: Path, degree: int) -> None:
    truth = gaussians(degree=degree)
    write_sog(tmp_path / "a.sog", truth)
    meta, found = read(tmp_path / "a.sog")
    assert (meta["version"], meta["count"]) == (2, 150)
    assert all(len(meta[name]["codebook"]) == 256 for name in ("scales", "sh0", *(["shN"] if degree else [])))
    order = scene_order(truth["means"].numpy())
    truth = {name: value[torch.from_numpy(order)] for name, value in truth.items()}
    # Half a level of an axis, times the largest slope of the inverse.
    step = (np.array(meta["means"]["maxs"]) - meta["means"]["mins"]) / 65535
    assert (np.abs(found["means"] - truth["means"].numpy()) <= step / 2 * 3 + 1e-6).all()
    assert np.abs(found["alphas"] - truth["opacities"].sigmoid().numpy()).max() <= 0.5 / 255 + 1e-6
    quats = torch.nn.functional.normalize(truth["quats"], dim=1).numpy()
    assert np.abs((found["quats"] * quats).sum(axis=1)).min() >= 1 - 6 * (0.5 / 255) ** 2
    for name in ("scales", "features_dc"):
        # 256 codebook entries for 450 values.
        assert np.abs(found[name] - truth[name].numpy()).max() < 0.05, name
    if degree:
        assert np.abs(found["features_rest"] - truth["features_rest"].numpy()).max() < 0.01


@pytest.mark.parametrize("n", [1, 2, 64, 65])
def test_few_equal_primitives(tmp_path: Path, n: int) -> None:
    truth = {name: value[:1].expand(n, *value.shape[1:]) for name, value in gaussians().items()}
    write_sog(tmp_path / "a.sog", truth)
    _, found = read(tmp_path / "a.sog")
    for name in ("means", "scales", "features_dc", "features_rest"):
        assert found[name].shape == truth[name].shape
        assert np.allclose(found[name], truth[name].numpy(), atol=1e-4), name


@given(st.lists(st.floats(-1e6, 1e6, width=32), min_size=1, max_size=600))
def test_codes_index_the_nearest_number(values: list[float]) -> None:
    given_values = np.array(values, np.float32)
    numbers, codes = codebook(given_values)
    assert numbers.shape == (256,)
    assert (np.diff(numbers) >= 0).all()
    distance = np.abs(given_values[:, None].astype(np.float64) - numbers)
    chosen = distance[np.arange(len(values)), codes]
    assert (chosen <= distance.min(axis=1) + 1e-6 * np.abs(given_values).max()).all()


def test_the_codebook_is_better_than_equal_steps() -> None:
    values = np.random.default_rng(0).laplace(size=20_000).astype(np.float32)
    numbers, codes = codebook(values)
    step = np.ptp(values) / 255
    equal = np.rint((values - values.min()) / step) * step + values.min()
    assert ((numbers[codes] - values) ** 2).mean() < 0.5 * ((equal - values) ** 2).mean()


def test_a_centre_without_rows_is_unchanged() -> None:
    rows = torch.full((50, 2), 3.0).double()
    centres = kmeans(rows, 4, torch.Generator().manual_seed(0))
    assert torch.equal(centres, rows[:4])


def test_a_palette_of_two_levels() -> None:
    generator = np.random.default_rng(0)
    centres = generator.normal(size=(40, 9)).astype(np.float32)
    rows = centres[generator.integers(40, size=3000)] + 0.01 * generator.normal(size=(3000, 9)).astype(np.float32)
    found, labels = palette(rows, 600)
    assert len(found) <= 600
    assert labels.max() < len(found)
    # 600 rows for 40 clusters with noise 0.01; a single row would have an error of 1.
    assert np.sqrt(((found[labels] - rows) ** 2).mean()) < 0.011
    same, each = palette(rows, 3000)
    assert np.array_equal(same[each], rows)
