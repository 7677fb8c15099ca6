"""Every reader of untrusted files: against damage, outside and inside of checksums and compression, and against paths.

Reading a file that names paths outside its folder writes nothing, runs nothing and opens no socket. An audit hook of
the interpreter records what a reader does (PEP 578).
"""

import json
import os
import shutil
import stat
import struct
import sys
import zipfile
import zlib
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from damage import INSIDE, damage
from foreign_files import FOREIGN, small_field, spz, write_checkpoint, write_columns
from hypothesis import HealthCheck, given, settings
from limits import refused, verdict
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from packed_scenes import full_scene, header_and_body, resealed, resection, sealed
from photos import photo
from PIL import Image
from run_commands import write_video
from small_captures import meta_of

import sundae_ns as sn
from sundae_ns.core.errors import PackError, SundaeError
from sundae_ns.core.gaussians import Gaussians
from sundae_ns.data.images import decoded_mask, reads_heif
from sundae_ns.data.photos import photo_of, upright
from sundae_ns.data.video import check_video, write_frames
from sundae_ns.io import checkpoint
from sundae_ns.io.formats import read_gaussian_file, read_gaussians, write_for_viewers, write_levels
from sundae_ns.io.pack import container
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene, read_scene, write_fitted
from sundae_ns.io.ply import Marks, read_ply, read_point_cloud, write_ply
from sundae_ns.plugin.dataparsers import LightNerfstudioParser, check_capture
from sundae_ns.scene.scene import from_points

HEADER = b"ply\nformat %s 1.0\nelement vertex %s\n%send_header\n"
XYZ = b"property float x\nproperty float y\nproperty float z\n"
FIELD, SCENE = small_field(60), full_scene(50, 2, 3, {"model": {"sh_degree": 2}})


def unpack(path):
    gaussians = read_scene(path).gaussians
    assert all(torch.isfinite(value).all() for value in gaussians.values())
    assert len({len(value) for value in gaussians.values()}) == 1


def write_cloud(path, text):
    columns = dict.fromkeys("xyz", np.linspace(-1, 1, 30, dtype=np.float32))
    write_columns(path, columns | dict.fromkeys(("red", "green", "blue"), np.zeros(30, np.uint8)), text=text)


def read_cloud(path):
    points, rgb = read_point_cloud(path)
    if torch.isfinite(points).all(dim=1).any():
        from_points(points, rgb.float() / 255, sh_degree=1)


def write_lod(path):
    write_levels(path.parent / "lod", [FIELD, small_field(20)], Marks())
    Path(shutil.make_archive(str(path), "zip", path.parent / "lod")).rename(path)


def write_path(path):
    row = {"camera_to_world": [float(i % 5 == 0) for i in range(16)], "fov": 50}
    path.write_text(json.dumps({"camera_path": [row] * 3, "render_width": 64, "render_height": 48, "fps": 24}))


def write_photo(path):
    assert reads_heif()
    photo(path, image=Image.fromarray(np.arange(3072, dtype=np.uint8).reshape(32, 32, 3)), orientation=6, focal=5.0)


def write_clip(path):
    write_video(path, 9)
    read_video(path)  # its threads reserve addresses once


def read_video(path):
    check_video(path)
    shutil.rmtree(path.with_suffix(""), ignore_errors=True)
    write_frames(path, path.with_suffix(""), 3, lambda _: None)


WRITERS = FOREIGN | dict.fromkeys(("a.spz", "a.sog", "a.glb"), write_for_viewers)
READERS = {
    **{name: (lambda path, write=write: write(path, FIELD), read_gaussian_file) for name, write in WRITERS.items()},
    "lod.sog": (write_lod, read_gaussian_file),
    "four.spz": (lambda path: path.write_bytes(spz(FIELD, 4, axes=8)), read_gaussian_file),
    "one.spz": (lambda path: path.write_bytes(spz(FIELD, 1)), read_gaussian_file),
    "field.ply": (lambda path: FOREIGN["plain.ply"](path, small_field(20)), read_gaussians),
    "cloud.ply": (lambda path: write_cloud(path, text=False), read_cloud),
    "text.ply": (lambda path: write_cloud(path, text=True), read_cloud),
    "a.ckpt": (lambda path: write_checkpoint(path, small_field(20)), read_gaussians),
    "a.sundae": (lambda path: write_fitted(path, *fit_scene(SCENE)), unpack),
    "page.html": (lambda path: sn.save(sn.Scene(Gaussians(small_field(20))), path), sn.load),
    "path.json": (write_path, sn.cameras_of),
    **{
        f"0.{kind}": (write_photo, lambda path: (upright(photo_of(path)), decoded_mask(path)))
        for kind in ("jpg", "png", "tif", "webp", "bmp", "heic")
    },
    **{f"a.{kind}": (write_clip, read_video) for kind in ("mp4", "mkv", "avi")},
}
"""Files by their names: a writer, and the reader that must survive them."""
many = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Contents of a valid file of :data:`READERS`."""
    folder = tmp_path_factory.mktemp("good")

    def content(name):
        if not (folder / name).exists():
            READERS[name][0](folder / name)
        return (folder / name).read_bytes()

    return content


@pytest.mark.parametrize("name", READERS)
def test_valid_files_are_read(good, tmp_path, name):
    (tmp_path / name).write_bytes(good(name))
    assert verdict(lambda: READERS[name][1](tmp_path / name), len(good(name))) is None


@pytest.mark.parametrize("name", READERS)
@many
@given(change=damage(), part=st.none() | st.integers(0, 99))
def test_damaged_files(good, tmp_path, name, change, part):
    inside = INSIDE.get(Path(name).suffix) if name != "four.spz" else None
    content = change(good(name)) if part is None or inside is None else inside(good(name), change, part)
    (tmp_path / name).write_bytes(content)
    error = verdict(lambda: READERS[name][1](tmp_path / name), len(content))
    if name == "a.sundae" and part is None:  # every byte is under a checksum
        assert isinstance(error, PackError) or content == good(name)


BINARY = b"binary_little_endian"
PLYS = {
    "no header": b"\x00" * 100,
    "end_header alone": b"end_header\n" + b"\x00" * 100,
    "only a header": HEADER % (BINARY, b"100", XYZ),
    "a huge count": HEADER % (BINARY, b"99999999999999", XYZ) + b"\x00" * 120,
    "a huge count of lists": HEADER % (BINARY, b"9999999999", b"property list int float x\n") + b"\x00" * 99,
    "a huge list": HEADER % (BINARY, b"1", b"property list uint double x\n") + b"\xff" * 4,
    "a huge list in text": HEADER % (b"ascii", b"1", b"property list uint double x\n") + b"4000000000 1\n",
    "a huge count in text": HEADER % (b"ascii", b"99999999999", XYZ) + b"0 0 0\n",
    "no properties": HEADER % (BINARY, b"99999999999", b""),
    "a negative count": HEADER % (BINARY, b"-5", XYZ),
    "a count that is a word": HEADER % (BINARY, b"many", XYZ),
    "x is a list": HEADER % (BINARY, b"1", b"property list uchar float x\n" + XYZ[17:]) + b"\x00" * 9,
    "x twice": HEADER % (BINARY, b"1", XYZ + XYZ) + b"\x00" * 24,
    "an unknown type": HEADER % (BINARY, b"1", b"property quad x\n") + b"\x00" * 24,
    "an unknown format": HEADER % (b"binary_middle_endian", b"1", XYZ) + b"\x00" * 24,
    "words instead of numbers": HEADER % (b"ascii", b"1", XYZ) + b"one two three\n",
    "two numbers instead of three": HEADER % (b"ascii", b"1", XYZ) + b"1 2\n",
    "an endless header": b"ply\nformat ascii 1.0\n" + b"comment la\n" * 30000,
}
PACKS = {
    "magic alone": b"\x89SUNDAE\n",
    "a checkpoint": b"PK\x03\x04" + bytes(200),
    "git lfs": b"version https://git-lfs.github.com/spec/v1",
    "deep JSON": sealed(b"[" * 100_000, b""),
    "a list": sealed(b"[]", b""),
    "a long header": b"\x89SUNDAE\n" + struct.pack("<II", 3, 2**32 - 1) + bytes(132),
}
ODD = [(reader, "a.ply", kind) for kind in PLYS for reader in (read_point_cloud, read_gaussians)]
ODD += [(read_scene, "ünï cöde.sundae", kind) for kind in PACKS]


@pytest.mark.parametrize(("reader", "name", "kind"), ODD)
def test_odd_files_are_refused(tmp_path, reader, name, kind):
    (tmp_path / name).write_bytes({**PLYS, **PACKS}[kind])
    refused(reader, tmp_path / name, kind * (kind == "git lfs"), PackError if kind in PACKS else SundaeError)


@pytest.mark.parametrize(("stated", "words"), [(1 << 27, "would unpack to"), (1 << 20, "cannot be decompressed")])
def test_bombs_are_refused_before_they_unpack(stated, words, good, tmp_path):
    deflate = zlib.compressobj(wbits=-15)
    # 320 MiB, beyond the limit of memory.
    stream = b"".join(deflate.compress(bytes(1 << 24)) for _ in range(20)) + deflate.flush()
    meta, body = header_and_body(good("a.sundae"))
    meta["sections"].append({"name": "a", "dtype": "|u1", "shape": [stated], "parts": [len(stream)]})
    (tmp_path / "a.sundae").write_bytes(resealed(meta, body + stream))
    refused(read_scene, tmp_path / "a.sundae", words, PackError)


def test_a_few_constant_planes_cannot_fill_the_memory(tmp_path):
    """Every section is within its limit, but the field that they describe is not."""
    n, path = 80_000, tmp_path / "a.sundae"
    write_fitted(path, *fit_scene(PackedScene({k: v[:1].expand(n, *v.shape[1:]) for k, v in SCENE.gaussians.items()})))
    meta, body = header_and_body(path.read_bytes())
    padding = meta["sections"].pop()
    assert padding["name"] == "padding"
    path.write_bytes(resealed(meta, body[: len(body) - sum(padding["parts"])]))
    refused(read_scene, path, "would unpack to", PackError)


PLACES = ["../../outside", "/tmp/outside-of-sundae", "a/../../../outside", "..\\..\\outside", "~/outside", "$HOME/a"]
ACTS = ("os.mkdir", "os.rename", "os.remove", "os.link", "os.symlink", "os.chmod", "os.system", "os.exec", "os.fork")
ACTS += ("os.posix_spawn", "subprocess.Popen", "socket.connect", "socket.bind", "shutil.unpack_archive")
recorded = []  # Acts since the last :func:`watched` began: an audit hook cannot be removed


def record(event, arguments):
    if event == "open":
        path, mode, flags = arguments
        writes = isinstance(mode, str) and any(letter in mode for letter in "wax+")
        if writes or (isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)):
            recorded.append(f"open {path!r} to write")
    elif event in ACTS:
        recorded.append(f"{event} {arguments!r}")


sys.addaudithook(record)


def watched(call):
    """What a call returns, and its acts."""
    recorded.clear()
    return call(), [*recorded]


def test_the_hook_records_writes_and_no_reads(tmp_path):
    (tmp_path / "b").touch()
    calls = (tmp_path / "a").mkdir, (tmp_path / "b").read_text, lambda: (tmp_path / "b").write_text("x")
    assert [[act.split()[0] for act in watched(call)[1]] for call in calls] == [["os.mkdir"], [], ["open"]]


def a_checkpoint(path, place):
    """Write a checkpoint that names ``place`` as a member of its archive, as the target of a link and as a tensor."""
    write_checkpoint(path, small_field(20), {place: torch.zeros(2)})
    with zipfile.ZipFile(path, "a", zipfile.ZIP_STORED) as archive:
        archive.writestr(place, b"outside")
        link = zipfile.ZipInfo("archive/link")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(link, place)


def a_pack(path, place):
    """Write a packed scene that names ``place`` throughout its header, and as a section, which readers may refuse."""
    about = {"source": {"method": place}, "name": place, "model": {"sh_degree": 1}}
    write_fitted(path, *fit_scene(PackedScene(small_field(20), meta=about)))
    resection(path, place, container.read_sections(path, container.read_header(path))["means/low"])


CASES = {
    "a.ckpt": (a_checkpoint, checkpoint.read),
    "b.ckpt": (a_checkpoint, read_gaussians),
    "a.sundae": (a_pack, read_scene),
    "a.ply": (lambda path, at: write_ply(path, small_field(20), comments=[at, f"TextureFile {at}"]), read_ply),
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", CASES)
def test_nothing_leaves_the_file(tmp_path, name, place):
    make, read = CASES[name]
    path = tmp_path / "deep" / "er" / name
    path.parent.mkdir(parents=True)
    make(path, place)
    assert watched(lambda: verdict(lambda: read(path), path.stat().st_size))[1] == []
    assert [entry.name for entry in path.parent.iterdir()] == [name]


@pytest.mark.parametrize("place", PLACES)
def test_reading_a_capture_writes_nothing(capture, place):
    meta = meta_of(capture)
    meta["frames"][0]["file_path"] = meta["ply_file_path"] = place
    (capture / "transforms.json").write_text(json.dumps(meta))
    parser = NerfstudioDataParserConfig(_target=LightNerfstudioParser, data=capture)
    error, acts = watched(lambda: verdict(lambda: check_capture(parser, capture, ("train",)), 10**4))
    assert error is not None
    assert acts == []
