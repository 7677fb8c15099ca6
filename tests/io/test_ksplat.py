""".ksplat files of GaussianSplats3D against the .ply that they were made of, and refusals in one line."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

import pytest
import torch
from foreign_files import KSPLAT, colors_of, copy_ksplat, ksplat
from torch import Tensor

import sundae_ns as sn
from sundae_ns.core.errors import DataError
from sundae_ns.core.gaussians import SPLAT_NAMES
from sundae_ns.io.splat import read_ksplat

SECTION = 4096  # offset of the first section's header
LENGTHS = 4096 + 2 * 1024  # and of the first section
HALF = 2**-10  # relative step of half precision; the largest one of values below 1 is half of it


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_values_are_those_of_the_ply(level: int, degree: int) -> None:
    """To make the files again, write ``KSPLAT`` with ``write_ply`` and give it to foreign/ksplat.mjs."""
    found = read_ksplat(ksplat(level, degree))
    assert tuple(sorted(found)) == tuple(sorted(SPLAT_NAMES))
    order = torch.cdist(found["means"], KSPLAT["means"]).argmin(dim=1)
    assert sorted(order.tolist()) == list(range(30))
    truth = {name: value[order] for name, value in KSPLAT.items()}
    truth["features_rest"] = truth["features_rest"][:, : (degree + 1) ** 2 - 1]

    def check(value: Tensor, expected: Tensor, error: float) -> None:
        torch.testing.assert_close(value, expected, rtol=0, atol=error)

    # Half a step of 16 bits in half a unit. All else is rounded down, by a whole step.
    check(found["means"], truth["means"], 0 if level == 0 else 0.5 * 0.25 / 32767 + 1e-7)
    check(found["scales"], truth["scales"], 1e-6 if level == 0 else 1.001 * HALF)
    quats = found["quats"] * (found["quats"] * truth["quats"]).sum(dim=1, keepdim=True).sign()
    check(quats, truth["quats"], 1e-6 if level == 0 else HALF / 2)
    check(colors_of(found), colors_of(truth), 1 / 255 + 1e-6)
    check(found["opacities"].sigmoid(), truth["opacities"].sigmoid(), 1 / 255 + 1e-6)
    check(found["features_rest"], truth["features_rest"], (0, HALF / 2, 2 / 255)[level])


def changed(path: Path, changes: Iterable[tuple[int, str, float]]) -> Path:
    """A copy of level 1 and SH degree 2 with other numbers at some offsets."""
    copy_ksplat(path)
    data = bytearray(path.read_bytes())
    for offset, kind, value in changes:
        struct.pack_into(kind, data, offset, value)
    path.write_bytes(data)
    return path


HOSTILE: dict[str, tuple[list[tuple[int, str, float]], str]] = {
    "another version": ([(1, "<B", 2)], "version 0.2 of the format, not 0.1"),
    "another level": ([(20, "<H", 3)], "level 3 of compression"),
    "sections beyond all": ([(4, "<I", 2**32 - 1)], "cannot hold 4,294,967,295 sections"),
    "more sections used than stored": ([(8, "<I", 3)], "cannot hold 3 sections"),
    "no sections": ([(8, "<I", 0)], "it has no Gaussians"),
    "an odd SH degree": ([(SECTION + 40, "<H", 3)], "SH degree 3; the format ends at 2"),
    "different SH degrees": ([(SECTION + 1024, "<I", 5), (SECTION + 1024 + 40, "<H", 1)], "different SH degrees"),
    "Gaussians beyond all": ([(SECTION, "<I", 2**32 - 1), (SECTION + 4, "<I", 2**32 - 1)], "a section of 4,294,967"),
    "more Gaussians used than stored": ([(SECTION, "<I", 17)], "a section of 17 Gaussians"),
    "buckets beyond all": ([(SECTION + 12, "<I", 2**32 - 1)], "cannot hold a section"),
    "no buckets": ([(SECTION + 12, "<I", 0)], "do not fit together"),
    "centres of other sizes": ([(SECTION + 20, "<H", 8)], "do not fit together"),
    "full buckets beyond all": ([(SECTION + 32, "<I", 2**32 - 1)], "do not fit together"),
    "buckets of an absurd size": ([(SECTION + 8, "<I", 2**32 - 1)], "do not hold 16 Gaussians"),
    "a last bucket of an absurd size": ([(LENGTHS, "<I", 2**32 - 1)], "do not hold 16 Gaussians"),
    "a sum beyond 32 bits": ([(LENGTHS + i, "<I", 2**31 + 1) for i in (0, 4)], "do not hold 16 Gaussians"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_files_are_refused_in_one_line(tmp_path: Path, kind: str) -> None:
    changes, words = HOSTILE[kind]
    with pytest.raises(DataError, match=r"a\.ksplat is not a complete \.ksplat") as caught:
        sn.load(changed(tmp_path / "a.ksplat", changes))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unstated_bounds_and_ranges_are_those_of_its_viewer(tmp_path: Path) -> None:
    """It takes SH coefficients in [-1.5, 1.5] and coordinates of 32,767 steps where a header has zeros."""
    data, path = bytearray(ksplat(2, 1).read_bytes()), tmp_path / "a.ksplat"
    struct.pack_into("<2f", data, 36, 0, 0)
    struct.pack_into("<I", data, SECTION + 24, 0)
    path.write_bytes(data)
    before, after = read_ksplat(ksplat(2, 1)), read_ksplat(path)
    low, high = struct.unpack_from("<2f", ksplat(2, 1).read_bytes(), 36)
    shares = (before["features_rest"] - low) / (high - low)
    torch.testing.assert_close(after["features_rest"], 3 * shares - 1.5, rtol=0, atol=1e-5)
    assert torch.equal(after["means"], before["means"])


def test_only_used_primitives_are_read(tmp_path: Path) -> None:
    """A file that was stored while it loaded has room for more."""
    found = read_ksplat(changed(tmp_path / "a.ksplat", [(SECTION, "<I", 3)]))
    whole = read_ksplat(ksplat(1, 2))
    assert all(torch.equal(found[name], torch.cat([whole[name][:3], whole[name][16:]])) for name in SPLAT_NAMES)
