"""Scenes of other programs, .ksplat among them: values against what was written, and refusals in one line."""

import math
import re
import struct
from functools import partial

import pytest
import torch
from fields import assert_close
from foreign_files import (
    FOREIGN,
    KSPLAT,
    copy_ksplat,
    ksplat,
    small_field,
    write_colored_ply,
    write_compressed_ply,
    write_gsplat,
    write_splat,
)
from limits import refused

import sundae_ns as sn
from sundae_ns.core.gaussians import SH_C0, SPLAT_NAMES
from sundae_ns.io.formats import read_gaussian_file
from sundae_ns.io.splat import read_ksplat
from sundae_ns.scene.describe import bytes_at


def write_old(path, gaussians):
    """As SuperSplat did at first: without bounds of colours, which reach from 0 to 1 here."""
    gaussians["features_dc"][:2] = torch.tensor([[-0.5], [0.5]]) / SH_C0
    write_compressed_ply(path, gaussians)
    path.write_bytes(re.sub(rb"(min|max)(_[rgb]\n)", rb"old_\1\2", path.read_bytes()))


FIELD, PLAIN, NAN = small_field(), small_field(degree=0), torch.full((300, 3), torch.nan)
# Half a level of a byte in 1 / 0.2821 and in 1, and of a quaternion before it is normalised.
SPLAT = {"scales": 1e-6, "quats": 0.011, "features_dc": 0.0072, "opacities": 0.002}
# Half a level: of 11 and 10 bits in 2 units, of 10 bits in sqrt(2), of 8 bits in 1 / 0.2821, in 1, and in 8.
COMPRESSED = {"means": 0.001, "scales": 0.001, "quats": 0.0015, "features_dc": 0.0075, "opacities": 0.002}
COMPRESSED |= {"features_rest": 0.016}
COLORED = {"quats": 1e-6, "features_dc": 0.0072, "opacities": 1e-6}
SIZES = [(1, 0, write_compressed_ply), (257, 3, write_compressed_ply), (256, 1, write_old), (200, 0, write_old)]
VALUES = [
    ("a.splat", PLAIN, write_splat, SPLAT),
    *(("a.ply", small_field(n, degree), write, COMPRESSED) for n, degree, write in SIZES),
    *(("colors.ply", PLAIN, partial(write_colored_ply, dtype=dtype, most=most), COLORED)
      for dtype, most in (("u1", 255), ("<u2", 65535), ("<f4", 1), ("<f4", 255))),
    ("ckpt_6999_rank0.pt", FIELD, write_gsplat, {"quats": 1e-6, "opacities": 1e-6}),
]  # fmt: skip


def read(path):
    return read_gaussian_file(path)[0].gaussians


@pytest.mark.parametrize(("name", "truth", "write", "tolerances"), VALUES)
def test_values_are_those_that_were_written(tmp_path, name, truth, write, tolerances):
    write(tmp_path / name, truth)
    sanitised, marks = read_gaussian_file(tmp_path / name)
    assert_close(sanitised.gaussians, truth, tolerances)
    assert marks.in_model_frame == (name == "colors.ply")


def test_ends_of_a_splat_have_a_meaning(tmp_path):
    given = small_field(4)
    given["opacities"][:2] = torch.tensor([[math.inf], [-math.inf]])
    given["scales"][2, 1] = -math.inf
    given["quats"][3] = 0
    write_splat(tmp_path / "a.splat", given)
    sanitised = read_gaussian_file(tmp_path / "a.splat")[0]
    assert sanitised.dropped == 0
    assert (sanitised.flat, sanitised.unrotated) == (1, 1)
    assert sanitised.gaussians["opacities"].sigmoid()[:2, 0].tolist() == pytest.approx([1, 0], abs=2e-6)
    assert all(value.isfinite().all() for value in sanitised.gaussians.values())


def test_the_ranks_of_gsplat_are_one_scene(tmp_path):
    """Each GPU writes its own part."""
    for rank in (0, 1, 2, 10):
        part = {name: value[min(rank, 3) :: 4] for name, value in FIELD.items()}
        write_gsplat(tmp_path / f"ckpt_6999_rank{rank}.pt", part)
    write_gsplat(tmp_path / "ckpt_29999_rank0.pt", FIELD)  # another step
    values = read(tmp_path / "ckpt_6999_rank1.pt")
    assert torch.equal(values["means"].sort(dim=0).values, FIELD["means"].sort(dim=0).values)
    assert bytes_at(tmp_path / "ckpt_6999_rank1.pt") == sum(path.stat().st_size for path in tmp_path.glob("*_6999_*"))


class Harmful:
    def __reduce__(self):
        return (open, ("harm", "w"))


def _saved(**splats):
    return lambda path: torch.save({"step": 1, "splats": splats}, path)


def _changed(name, change):
    """A valid file whose bytes are changed."""

    def write(path):
        FOREIGN[name](path, FIELD)
        path.write_bytes(change(path.read_bytes()))

    return write


def _renamed(old, new):
    return _changed("a.compressed.ply", lambda data: data.replace(old, new))


DAMAGED = {
    "an empty .splat": ("a.splat", lambda path: path.touch(), "0 Gaussians"),
    "a web page": ("a.splat", lambda path: path.write_text("<!DOCTYPE HTML>" + 49 * " "), "web page; download the f"),
    "an image": ("a.splat", lambda path: path.write_bytes(b"\xff\xd8\xff\xe1" * 16), "has negative widths"),
    "another text": ("a.splat", lambda path: path.write_text(32 * "ä"), "it is text"),
    "a pointer of LFS": ("a.ply", lambda path: path.write_text("version https://git-lfs.github.com/"), "git lfs pull"),
    "half a Gaussian": ("a.splat", _changed("a.splat", lambda data: data[:48]), "a multiple of element size"),
    "a short compressed .ply": ("a.ply", _changed("a.compressed.ply", lambda data: data[:2000]), "header states at"),
    "no chunks": ("a.ply", _renamed(b"element chunk", b"element chump"), "compressed .ply"),
    "too few chunks": ("a.ply", _renamed(b"vertex 300", b"vertex 999"), "its header states"),
    "no bound": ("a.ply", _renamed(b"min_scale_x", b"min_scale_u"), "compressed .ply"),
    "odd harmonics": ("a.ply", _renamed(b"f_rest_8", b"unknown8"), "fit no SH degree"),
    "no archive": ("a.pt", lambda path: path.write_bytes(b"PK\x03\x04" + b"\x00" * 99), "not a checkpoint of gsplat"),
    "an old archive": ("a.pt", lambda path: path.write_bytes(b"\x80\x02" * 50), "not a checkpoint of gsplat"),
    "a cut archive": ("a.pt", _changed("ckpt_6999_rank0.pt", lambda data: data[:3000]), "not a checkpoint of gsplat"),
    "code": ("a.pt", lambda path: torch.save({"splats": Harmful()}, path), "more than tensors and plain values"),
    "no splats": ("a.pt", lambda path: torch.save({"step": 1}, path), "it holds no splats"),
    "no harmonics": ("a.pt", _saved(means=torch.zeros(3, 3)), "its splats lack scales, quats, sh0, shN, opacities"),
    "colours of a network": ("a.pt", _saved(colors=torch.zeros(3, 3)), "its colours need a network"),
    "an odd shape": ("a.pt", lambda path: write_gsplat(path, FIELD | {"scales": FIELD["quats"]}), "scales has shape"),
    "words of floats": ("a.ply", _renamed(b"uint packed_scale", b"float packed_scale"), "are of another type"),
    "complex": ("a.pt", lambda path: write_gsplat(path, FIELD | {"scales": 1j * FIELD["scales"]}), "lack scales, or"),
    "sparse": ("a.pt", _saved(means=torch.zeros(3, 3).to_sparse()), "sparse"),
    "a missing file": ("a.splat", lambda _: None, "cannot be read"),
    "NaN": ("a.splat", lambda path: write_splat(path, FIELD | {"means": NAN}), "300 Gaussians, and none is finite"),
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_damaged_files_are_refused_in_one_line(tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    name, write, words = DAMAGED[kind]
    write(tmp_path / name)
    refused(read_gaussian_file, tmp_path / name, words)
    assert not (tmp_path / "harm").exists()


SECTION = 4096  # offset of the first section's header
LENGTHS = 4096 + 2 * 1024  # and of the first section
HALF = 2**-10  # relative step of half precision; the largest one of values below 1 is half of it


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_values_of_a_ksplat_are_those_of_the_ply(level, degree):
    """To make the files again, write ``KSPLAT`` with ``write_ply`` and give it to foreign/ksplat.mjs."""
    truth = {**KSPLAT, "features_rest": KSPLAT["features_rest"][:, : (degree + 1) ** 2 - 1]}
    # Half a step of 16 bits in half a unit. All else is rounded down, by a whole step.
    tolerances = {"features_dc": 0.014, "opacities": 1 / 255 + 1e-6, "features_rest": (0, HALF / 2, 2 / 255)[level]}
    tolerances |= {"means": 4e-6, "scales": 1.001 * HALF, "quats": HALF} if level else {"scales": 1e-6, "quats": 1e-6}
    assert_close(read_ksplat(ksplat(level, degree))[0], truth, tolerances)


def changed(path, changes):
    """A copy of level 1 and SH degree 2 with other numbers at some offsets."""
    copy_ksplat(path)
    data = bytearray(path.read_bytes())
    for offset, kind, value in changes:
        struct.pack_into(kind, data, offset, value)
    path.write_bytes(data)
    return path


HOSTILE_KSPLATS = {
    "another version": ([(1, "<B", 2)], "version 0.2"),
    "another level": ([(20, "<H", 3)], "level 3"),
    "sections beyond all": ([(4, "<I", 2**32 - 1), (8, "<I", 2**32 - 1)], "buffer"),
    "more sections used than stored": ([(8, "<I", 3)], "not version"),
    "no sections": ([(8, "<I", 0)], "it states 0 Gaussians"),
    "an odd SH degree": ([(SECTION + 40, "<H", 3)], "do not fit together"),
    "Gaussians beyond all": ([(SECTION, "<I", 2**32 - 1), (SECTION + 4, "<I", 2**32 - 1)], "buffer"),
    "more Gaussians used than stored": ([(SECTION, "<I", 17)], "do not fit together"),
    "buckets beyond all": ([(SECTION + 12, "<I", 2**32 - 1), (SECTION + 32, "<I", 2**32 - 3)], "together|buffer"),
    "no buckets": ([(SECTION + 12, "<I", 0)], "do not fit together"),
    "centres of other sizes": ([(SECTION + 20, "<H", 8)], "do not fit together"),
    "full buckets beyond all": ([(SECTION + 32, "<I", 2**32 - 1)], "do not fit together"),
    "buckets of an absurd size": ([(SECTION + 8, "<I", 2**32 - 1)], "do not hold 16 Gaussians"),
    "a last bucket of an absurd size": ([(LENGTHS, "<I", 2**32 - 1)], "do not hold 16 Gaussians"),
    "a sum beyond 32 bits": ([(LENGTHS + i, "<I", 2**31 + 1) for i in (0, 4)], "do not hold 16 Gaussians"),
}


@pytest.mark.parametrize("kind", HOSTILE_KSPLATS)
def test_hostile_ksplats_are_refused_in_one_line(tmp_path, kind):
    changes, words = HOSTILE_KSPLATS[kind]
    path = changed(tmp_path / "a.ksplat", changes)
    refused(sn.load, path, rf"a\.ksplat is not a complete \.ksplat .*({words})")


def test_sections_of_a_ksplat_may_have_other_sh_degrees(tmp_path):
    path = changed(tmp_path / "a.ksplat", [(SECTION + 1024, "<I", 5), (SECTION + 1024 + 40, "<H", 1)])
    rest = read_ksplat(path)[0]["features_rest"]
    assert rest[:-5, 3:].any()
    assert not rest[-5:, 3:].any()


def test_unstated_bounds_of_a_ksplat_and_ranges_are_those_of_its_viewer(tmp_path):
    """It takes SH coefficients in [-1.5, 1.5] and coordinates of 32,767 steps where a header has zeros."""
    data, path = bytearray(ksplat(2, 1).read_bytes()), tmp_path / "a.ksplat"
    struct.pack_into("<2f", data, 36, 0, 0)
    struct.pack_into("<I", data, SECTION + 24, 0)
    path.write_bytes(data)
    before, after = read_ksplat(ksplat(2, 1))[0], read_ksplat(path)[0]
    low, high = struct.unpack_from("<2f", ksplat(2, 1).read_bytes(), 36)
    shares = (before["features_rest"] - low) / (high - low)
    torch.testing.assert_close(after["features_rest"], 3 * shares - 1.5, rtol=0, atol=1e-5)
    assert torch.equal(after["means"], before["means"])


def test_only_used_gaussians_of_a_ksplat_are_read(tmp_path):
    """A file that was stored while it loaded has room for more."""
    values = read_ksplat(changed(tmp_path / "a.ksplat", [(SECTION, "<I", 3)]))[0]
    whole = read_ksplat(ksplat(1, 2))[0]
    assert all(torch.equal(values[name], torch.cat([whole[name][:3], whole[name][16:]])) for name in SPLAT_NAMES)
