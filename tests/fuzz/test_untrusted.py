"""Untrusted files that name paths outside their folder: reading them writes nothing, runs nothing and opens no socket.

An audit hook of the interpreter records what a reader does (PEP 578).
"""

import io
import json
import os
import stat
import sys
import zipfile
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from foreign_files import small_field, write_checkpoint
from limits import verdict
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from packed_scenes import resection
from small_captures import meta_of

from sundae_ns.io import checkpoint
from sundae_ns.io.formats import read_gaussians, write_for_viewers
from sundae_ns.io.pack import container
from sundae_ns.io.pack.packed_scene import PackedScene, read_scene, write_scene
from sundae_ns.io.ply import read_ply, write_ply
from sundae_ns.plugin.dataparsers import LightNerfstudioParser, check_capture

PLACES = (
    "../../outside",
    "/tmp/outside-of-sundae",
    "..\\..\\outside",
    "a/../../../outside",
    "~/outside",
    "$HOME/outside",
)
ACTS = ("os.mkdir", "os.rename", "os.remove", "os.link", "os.symlink", "os.chmod", "os.system", "os.exec", "os.fork")
ACTS += ("os.posix_spawn", "subprocess.Popen", "socket.connect", "socket.bind", "shutil.unpack_archive")
recorded = None
"""Acts recorded in :func:`watched`; None outside of it, because an audit hook cannot be removed."""


def record(event, arguments):
    if recorded is None:
        return
    if event == "open":
        path, mode, flags = arguments
        writes = isinstance(mode, str) and any(letter in mode for letter in "wax+")
        if writes or (isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)):
            recorded.append(f"open {path!r} to write")
    elif event in ACTS:
        recorded.append(f"{event} {arguments!r}")


sys.addaudithook(record)


@contextmanager
def watched():
    """Yield a list to which the acts of the block are added."""
    global recorded  # noqa: PLW0603
    recorded = []
    try:
        yield recorded
    finally:
        recorded = None


def test_the_hook_records_writes_and_no_reads(tmp_path):
    with watched() as found:
        (tmp_path / "a").mkdir()
        (tmp_path / "a" / "b").write_text("x")
        (tmp_path / "a" / "b").read_text()
    assert [line.split()[0] for line in found] == ["os.mkdir", "open"]


def a_checkpoint(path, place):
    """Write a checkpoint that names ``place`` as a member of its archive, as the target of a link and as a tensor."""
    buffer = io.BytesIO()
    write_checkpoint(buffer, small_field(20), {place: torch.zeros(2)})
    with zipfile.ZipFile(buffer, "a", zipfile.ZIP_STORED) as archive:
        archive.writestr(place, b"outside")
        link = zipfile.ZipInfo("archive/link")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(link, place)
    path.write_bytes(buffer.getvalue())


def a_pack(path, place):
    """Write a packed scene that names ``place`` throughout its header, and as a section, which readers may refuse."""
    about = {"source": {"method": place}, "name": place, "model": {"sh_degree": 1}}
    write_scene(path, PackedScene(small_field(20), meta=about))
    resection(path, place, container.read_sections(path, container.read_header(path))["means/low"])


def a_ply(path, place):
    """Write a .ply that names ``place`` in its comments."""
    write_ply(path, small_field(20), comments=[place, f"TextureFile {place}"])


CASES = {
    "a.ckpt": (a_checkpoint, checkpoint.read),
    "b.ckpt": (a_checkpoint, read_gaussians),
    "a.sundae": (a_pack, read_scene),
    "a.ply": (a_ply, read_ply),
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", CASES)
def test_nothing_leaves_the_file(tmp_path, name, place):
    make, read = CASES[name]
    path = tmp_path / "deep" / "er" / name
    path.parent.mkdir(parents=True)
    make(path, place)
    with watched() as found:
        verdict(lambda: read(path), path.stat().st_size)
    assert found == []
    assert [entry.name for entry in path.parent.iterdir()] == [name]


def test_members_of_an_exported_archive_are_plain_names(tmp_path):
    """A .sog is a zip that other programs unpack."""
    write_for_viewers(tmp_path / "a.sog", small_field(20))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        names = archive.namelist()
    assert "meta.json" in names
    assert all(Path(name).name == name for name in names)


@pytest.mark.parametrize("place", PLACES)
def test_reading_a_capture_writes_nothing(capture, place):
    meta = meta_of(capture)
    meta["frames"][0]["file_path"] = meta["ply_file_path"] = place
    (capture / "transforms.json").write_text(json.dumps(meta))
    parser = NerfstudioDataParserConfig(_target=LightNerfstudioParser, data=capture)
    with watched() as found:
        error = verdict(lambda: check_capture(parser, capture, ("train",)), 10**4)
    assert error is not None
    assert found == []
