"""Files of .spz, read by gsply's C++ reader; test_viewers.py reads them with another program."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.gaussians import from_points
from sundae_ns.storage.spz import _HARMONICS_STEP, fractional_bits, write_spz

HEADER = struct.Struct("<IIIBBBB")


def field(n: int = 50, degree: int = 3) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(n, 3, generator=generator)
    made = from_points(points, points, sh_degree=degree, num_features=3, generator=generator)
    made["quats"] = torch.randn(n, 4, generator=generator)
    made["scales"] = -5 + torch.randn(n, 3, generator=generator)
    made["features_rest"] = torch.rand(made["features_rest"].shape, generator=generator) - 0.5
    made["opacities"] = 2 * torch.randn(n, 1, generator=generator)
    return made


def read(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = pytest.importorskip("gsply_cpp").read_spz(str(path))
    return found


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_values_come_back_within_the_steps_of_the_format(tmp_path: Path, degree: int) -> None:
    truth = field(degree=degree)
    write_spz(tmp_path / "a.spz", truth)
    found = read(tmp_path / "a.spz")
    assert np.abs(found["means"] - truth["means"].numpy()).max() <= 2.0 ** -fractional_bits(truth["means"])
    assert np.abs(found["scales"] - truth["scales"].numpy()).max() <= 1 / 32 + 1e-6
    alphas = 1 / (1 + np.exp(-found["opacities"].reshape(-1, 1)))
    assert np.abs(alphas - truth["opacities"].sigmoid().numpy()).max() <= 0.5 / 255 + 1e-6
    assert np.abs(found["sh0"] - truth["features_dc"].numpy()).max() <= 0.5 / (0.15 * 255) + 1e-6
    quats = torch.nn.functional.normalize(truth["quats"], dim=1).numpy()
    cosines = np.abs((found["quats"] / np.linalg.norm(found["quats"], axis=1, keepdims=True) * quats).sum(axis=1))
    # Half a step of each of three components, and the resulting error of the largest one.
    assert cosines.min() >= 1 - 6 * (0.5 / 511) ** 2
    if degree:
        rest = found["shN"].reshape(truth["features_rest"].shape)
        assert np.abs(rest - truth["features_rest"].numpy()).max() <= _HARMONICS_STEP / 2 + 1e-6


@pytest.mark.parametrize("antialiased", [False, True])
def test_header(tmp_path: Path, antialiased: bool) -> None:
    write_spz(tmp_path / "a.spz", field(), antialiased=antialiased)
    raw = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert HEADER.unpack_from(raw) == (0x5053474E, 3, 50, 3, fractional_bits(field()["means"]), int(antialiased), 0)
    assert len(raw) == HEADER.size + 50 * (9 + 1 + 3 + 3 + 4 + 45)


@pytest.mark.parametrize(
    ("farthest", "bits"), [(0.0, 24), (0.25, 24), (1.0, 22), (2.0, 21), (-2000.0, 12), (2048.0, 11)]
)
def test_positions_get_as_many_bits_as_fit(tmp_path: Path, farthest: float, bits: int) -> None:
    assert fractional_bits(torch.tensor([[0.0, farthest, 0.0]])) == bits
    moved = field()
    moved["means"][0, 1] = farthest
    moved["means"].clamp_(-abs(farthest), abs(farthest))
    write_spz(tmp_path / "a.spz", moved)
    error = np.abs(read(tmp_path / "a.spz")["means"] - moved["means"].numpy())
    assert error.max() <= 2.0 ** -(bits + 1) + 1e-7


def test_zero_quaternions_become_the_identity(tmp_path: Path) -> None:
    given = field()
    given["quats"][0] = 0
    given["quats"][1] = torch.tensor([0.0, 1e-30, 0.0, 0.0])
    write_spz(tmp_path / "a.spz", given)
    quats = read(tmp_path / "a.spz")["quats"]
    assert np.allclose(quats[:2], [[1, 0, 0, 0], [0, 1, 0, 0]])


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"means": torch.zeros(0, 3)}, "has shape"),
        ({"features_rest": torch.zeros(50, 24, 3)}, "degrees up to 3"),
        ({"opacities": torch.full((50, 1), torch.nan)}, "NaN or infinite"),
        ({"means": torch.full((50, 3), 1e5)}, "1e.05 from the origin"),
    ],
)
def test_refusals_leave_the_older_file(tmp_path: Path, change: dict[str, Tensor], cause: str) -> None:
    (tmp_path / "a.spz").write_bytes(b"older")
    with pytest.raises(DataError, match=cause):
        write_spz(tmp_path / "a.spz", {**field(), **change})
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"older"]


def test_no_primitives(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no primitives"):
        write_spz(tmp_path / "a.spz", {name: value[:0] for name, value in field().items()})
