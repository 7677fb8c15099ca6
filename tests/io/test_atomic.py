"""Atomic writes: after any error a file is complete or unchanged."""

import errno
import os
import signal
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from foreign_files import small_field
from PIL import Image

from sundae_ns.core.errors import DataError, MemoryExhaustedError, PackError, StorageError, reading, regular, writing
from sundae_ns.core.files import locked, put_aside, replacing, write_files, write_image, write_text
from sundae_ns.io.ply import write_ply

resource = pytest.importorskip("resource", reason="Windows has none")


@contextmanager
def small_disk(limit):
    """Limit the size of any file to ``limit`` bytes, like a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


def test_an_error_while_writing_leaves_the_old_file(tmp_path):
    write_text(tmp_path / "a.txt", "old")

    def fail():
        with replacing(tmp_path / "a.txt") as unfinished:
            unfinished.write_text("half")
            assert (tmp_path / "a.txt").read_text() == "old"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert (tmp_path / "a.txt").read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_file_is_flushed_before_it_is_renamed(tmp_path, monkeypatch):
    order = []
    sync, replace = os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (order.append("sync"), sync(handle))[1])
    monkeypatch.setattr(Path, "replace", lambda path, to: (order.append("rename"), replace(path, to))[1])
    write_text(tmp_path / "new" / "folder" / "a.txt", "new")
    assert order == ["sync", "rename", "sync"]
    assert (tmp_path / "new" / "folder" / "a.txt").read_text() == "new"


def test_files_that_belong_together_are_written_all_or_none(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    with small_disk(10_000), pytest.raises(StorageError, match="cannot write .*b.txt"):
        write_files({tmp_path / "a.txt": b"new", tmp_path / "b.txt": b"x" * 10_001})
    assert (tmp_path / "a.txt").read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]
    write_files({tmp_path / "a.txt": b"new", tmp_path / "b.txt": b"x"})
    assert [(tmp_path / name).read_text() for name in ("a.txt", "b.txt")] == ["new", "x"]


def test_what_killed_processes_left_is_removed_and_what_others_write_stays(tmp_path):
    path, other, longer = (tmp_path / f"[a].txt{end}" for end in ("", ".7.partial", ".ply.7.partial"))
    longer.touch()
    with other.open("w") as unfinished:
        assert locked(unfinished)
        with replacing(path) as ours, replacing(path) as theirs, ours.open("w") as file:
            assert ours != theirs  # of two threads, or of processes of one number in two containers
            assert locked(file) is False  # nobody else removes it
        assert other.exists()
    write_text(path, "new")
    assert sorted(os.listdir(tmp_path)) == ["[a].txt", longer.name]


@pytest.mark.parametrize("name", ["a.ply", "a.png", "a.jpg", "a.webp"])
def test_full_disk(tmp_path, name):
    noise, field = Image.effect_noise((400, 300), 100), small_field(1000)
    write = partial(write_ply, params=field) if name == "a.ply" else partial(write_image, image=noise)
    (tmp_path / name).write_text("old")
    with small_disk(10_000), pytest.raises(StorageError, match=rf"^cannot write .*{name}: .*ulimit.*$"):
        write(tmp_path / name)
    assert (tmp_path / name).read_text() == "old"
    assert os.listdir(tmp_path) == [name]
    write(tmp_path / name)
    assert (tmp_path / name).stat().st_size > 10_000


@pytest.mark.parametrize(
    ("error", "kind", "message"),
    [
        (OSError(errno.ENOSPC, "no"), StorageError, "cannot make a: the disk is full; make room$"),
        (OSError(errno.EACCES, "no"), StorageError, "cannot make a: permission denied"),
        (OSError(errno.ENOENT, "no"), StorageError, "cannot make a: .*missing"),
        (OSError(errno.EMFILE, "too many open files"), OSError, r"\[Errno \d+\] too many open files"),
        (StorageError("cannot write b: denied"), StorageError, "cannot write b: denied$"),
    ],
)
def test_errors_that_a_user_can_correct_are_one_line(error, kind, message):
    with pytest.raises(OSError, match=f"^{message}") as caught, writing("cannot make a"):
        raise error
    assert type(caught.value) is kind


def test_a_full_disk_is_found_behind_the_error_that_replaces_it(tmp_path):
    """torch replaces the error of a failed write by its own when it closes the archive."""
    full = Mock(write=Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(StorageError, match="disk is full"), replacing(tmp_path / "a.ckpt"):
        torch.save({"values": torch.zeros(9)}, full)


def test_only_regular_files_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(OSError, match="it is a pipe or a device, not a file"):
            regular(path)
    (tmp_path / "file").touch()
    for path in (tmp_path / "file", tmp_path, tmp_path / "missing"):
        assert regular(path) == path


@pytest.mark.parametrize(
    ("raised", "kind", "message"),
    [
        (FileNotFoundError(2, "No such file"), PackError, r"a\.x cannot be read \(No such file\); check the path"),
        (KeyError("means\n twice"), PackError, r"a\.x is not a whole x \('means\\n twice'\); get it again"),
        (ValueError(), PackError, r"a\.x is not a whole x \(ValueError\); get it again"),
        (DataError("one of ours; mend it"), DataError, "one of ours; mend it"),
        (MemoryError("9 GB"), MemoryExhaustedError, r"the memory is full with a\.x \(9 GB\); end other programs"),
        (RuntimeError("DefaultCPUAllocator: a"), MemoryExhaustedError, "the memory is full with .*"),
    ],
)
def test_errors_of_reading_name_the_file(raised, kind, message):
    with pytest.raises(kind, match=f"^{message}$"), reading(Path("a.x"), "a whole x", PackError, remedy="get it again"):
        raise raised


def test_what_is_damaged_is_put_aside(tmp_path):
    put_aside(tmp_path / "gone")
    for text in ("first", "second"):
        (tmp_path / "a").mkdir()
        (tmp_path / "a" / "b").write_text(text)
        (tmp_path / "c").write_text(text)
        for name in ("a", "c"):
            put_aside(tmp_path / name)
    assert sorted(os.listdir(tmp_path)) == ["a.damaged", "c.damaged"]
    assert (tmp_path / "a.damaged" / "b").read_text() == (tmp_path / "c.damaged").read_text() == "second"
