"""Files of .spz of every version, made by the specification: values, stated axes, and sizes that lie."""

import gzip
import struct

import pytest
import torch
import zstandard
from fields import assert_close, assert_moved
from foreign_files import small_field, spz
from limits import refused

import sundae_ns as sn
from sundae_ns.io.ply import Marks
from sundae_ns.io.spz import read_spz, write_spz


@pytest.mark.parametrize(("version", "degree"), [(1, 3), (2, 0), (3, 4), (4, 1), (4, 0)])
def test_values_of_every_version(tmp_path, version, degree):
    """A browser that has unpacked gzip stores what is inside."""
    truth = small_field(200, degree)
    content = spz(truth, version, antialiased=degree == 4)
    (tmp_path / "b.spz").write_bytes(gzip.decompress(content) if version < 4 else content)
    (tmp_path / "a.spz").write_bytes(content)
    found, (antialiased, *_) = read_spz(tmp_path / "a.spz")
    assert_close(read_spz(tmp_path / "b.spz")[0], found, dict.fromkeys(found, 0))
    assert antialiased == (degree == 4)
    # Half a step each; half precision near 1 has steps of 2^-11, three bytes near a rotation of pi tell w badly.
    tolerances = {"means": 2**-11 if version == 1 else 2**-13, "scales": 1 / 32, "features_dc": 0.0134}
    tolerances |= {"features_rest": 1 / 128, "opacities": 0.5 / 255, "quats": 0.0015 if version > 2 else 0.1}
    assert_close(found, truth, {name: tolerance + 1e-6 for name, tolerance in tolerances.items()})
    signs = (found["quats"] * truth["quats"]).sum(dim=1, keepdim=True).sign()
    assert ((found["quats"] * signs - truth["quats"])[:, 1:].abs() <= 1 / 127 + 1e-6).all()


def test_the_longest_marks_fit_into_the_comment(tmp_path, monkeypatch):
    monkeypatch.setattr("gsply.spz._gzip_compress", None)  # the file is compressed once, with its comment
    marks = Marks(True, True, (-2 / 3, 1 / 3, 2 / 3), (1e6 / 3, -1e5 / 7, -4e6 / 3))
    write_spz(tmp_path / "a.spz", small_field(9), marks)
    assert read_spz(tmp_path / "a.spz")[1] == marks


AXES = {"LDB": 1, "RUB": 4, "RDF": 6, "LUF": 7, "RUF": 8, "RBD": 10, "RFU": 16}  # numbers in Adobe's extension


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("version", [3, 4])
def test_stated_axes_are_turned_to_those_of_a_ply(tmp_path, version, axes):
    """Each Gaussian is where it was to the right, down and forward, and shows the same colours from there."""
    truth = small_field(50, 3)
    (tmp_path / "a.spz").write_bytes(spz(truth, version))
    plain = read_spz(tmp_path / "a.spz")[0]
    (tmp_path / "a.spz").write_bytes(spz(truth, version, axes=AXES[axes]))
    found = read_spz(tmp_path / "a.spz")[0]
    ways = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
    assert_moved(found, plain, torch.tensor([ways[letter] for letter in axes], dtype=torch.float32).T)


def _with_stream(content, size):
    """The positions are a frame of another size, which the table states as the right one."""
    frame, stored = zstandard.compress(bytes(size), 1), struct.unpack_from("<Q", content, 32)[0]
    return content[:32] + struct.pack("<Q", len(frame)) + content[40:128] + frame + content[128 + stored :]


def _cut(content, count):
    """Without the last bytes of its extensions, which end at byte 56."""
    return content[:16] + bytes([56 - count]) + content[17 : 56 - count] + content[56:]


FIELD = small_field(100, 1)
HOSTILE = {
    "a second member": (lambda: spz(FIELD, 3) + gzip.compress(bytes(1 << 27), 1), "unpacks to more"),
    "a frame of 256 MB": (lambda: _with_stream(spz(FIELD, 4), 1 << 28), "has not the 900 bytes"),
    "a short frame": (lambda: _with_stream(spz(FIELD, 4), 7), "has not the 900 bytes"),
    "four billion Gaussians": (lambda: spz(FIELD, 4, count=2**32 - 1), "would unpack to"),
    "no Gaussians": (lambda: spz(FIELD, 3, count=0), "it states 0 Gaussians"),
    "fewer bytes than Gaussians": (lambda: spz(FIELD, 3, count=101), "bytes are missing"),
    "SH degree 5": (lambda: spz(FIELD, 3, degree=5), "35 SH coefficients"),
    "a cut stream": (lambda: spz(FIELD, 3)[:-9], "ended before"),
    "a wrong checksum": (lambda: spz(FIELD, 3)[:-8] + bytes(8), "CRC.*; export it again"),
    "a lower SH degree": (lambda: spz(FIELD, 3, degree=0), "unpacks to more"),
    "levels of detail": (lambda: spz(FIELD, 4)[:14] + b"\x80" + spz(FIELD, 4)[15:], "b'NGSP' 4 128, is not that"),
    "version 5": (lambda: spz(FIELD, 5), "version 1 to 4"),
    "version 4 in gzip": (lambda: gzip.compress(spz(FIELD, 4)), "version 1 to 4"),
    "another gzip file": (lambda: gzip.compress(b"ply" * 9), "version 1 to 4; gunzip other files"),
    "99 fractional bits": (lambda: spz(FIELD, 3, bits=99), "version 1 to 4"),
    "cut axes": (lambda: _cut(spz(FIELD, 4, axes=8), 2), "its extensions end 2 bytes early"),
    "no axes": (lambda: _cut(spz(FIELD, 4, axes=8), 24), "not a complete .spz .*8 bytes"),
    "unknown axes": (lambda: spz(FIELD, 4, axes=17), "axes number 17, and known are 1 to 16"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_files(tmp_path, kind):
    make, words = HOSTILE[kind]
    (tmp_path / "a.spz").write_bytes(make())
    refused(sn.load, tmp_path / "a.spz", words)
