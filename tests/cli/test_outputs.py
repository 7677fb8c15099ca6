"""What commands may write, and what they may read: nothing is lost, nothing hangs, a full disk is one line."""

import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
import torch
from command_line import refusal, run

import sundae_ns as sn
from sundae_ns.cli.refusals import check_file, check_folder
from sundae_ns.core.errors import StorageError


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with a scene in two formats, as current folder."""
    monkeypatch.chdir(tmp_path)
    scene = sn.Scene.from_points(torch.rand(400, 3), torch.rand(400, 3), sh_degree=1)
    for name in ("a.ply", "a.sundae"):
        sn.save(scene, name)
    return tmp_path


@pytest.mark.parametrize("link", [None, os.symlink, os.link])
@pytest.mark.parametrize("more", [[], ["--overwrite"]])
def test_no_command_writes_onto_its_input(here, capsys, link, more):
    before = (here / "a.ply").read_bytes()
    out = "a.ply" if link is None else "b.ply"
    if link is not None:
        link("a.ply", out)
    if link is os.link and more:  # the other name stays
        assert run("prune", "a.ply", "-o", out, "--num-cameras", "2", *more) == 0
    else:
        assert out in refusal(capsys, "prune", "a.ply", "-o", out, *more)
    assert (here / "a.ply").read_bytes() == before


@pytest.mark.parametrize("words", ["prune a.ply -o b.ply --num-cameras 2", "export a.ply -o b.spz"])
def test_an_existing_output_needs_overwrite(here, capsys, words):
    words, out = words.split(), here / words.split()[3]
    assert run(*words) == 0
    first = out.stat().st_mtime_ns
    assert "--overwrite" in refusal(capsys, *words)
    assert out.stat().st_mtime_ns == first
    assert run(*words, "--overwrite") == 0
    assert out.stat().st_mtime_ns > first


def test_parts_of_a_run_are_no_output(tmp_path):
    models, config, packed = (tmp_path / name for name in ("nerfstudio_models", "config.yml", "scene.sundae"))
    models.mkdir()
    for path in (config, models / "step-1.ckpt"):
        path.touch()
        with pytest.raises(StorageError, match="belongs to what the command reads"):
            check_file(path, reads=[config, models, None], overwrite=True)
    check_file(packed, reads=[config, models, None], overwrite=False)
    packed.touch()
    check_file(packed, reads=[config, models, None], overwrite=True)


def test_only_files_and_folders_are_replaced(here):
    os.mkfifo(here / "pipe")
    for path in (here, here / "pipe", Path(os.devnull)):
        with pytest.raises(StorageError, match="name a file"):
            check_file(path, reads=[], overwrite=True)
    with pytest.raises(StorageError, match="is a file; choose another folder"):
        check_folder(here / "a.ply", reads=[], overwrite=True)
    (here / "empty").mkdir()
    check_folder(here / "empty", reads=[], overwrite=False)


READING = ["prune in -o x.ply", "export in -o x.spz", "export run -o x.spz", "pack in.html -o x.sundae"]


@pytest.mark.parametrize("words", [*READING, "compare in -o x", "compare run -o x"])
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_what_is_no_file_is_refused_at_once(here, capsys, words, kind):
    (here / "run" / "nerfstudio_models").mkdir(parents=True)
    for path in ("in", "in.html", "run/config.yml", "run/nerfstudio_models/step-000000001.ckpt"):
        if kind == "pipe":
            os.mkfifo(here / path)
        else:
            (here / path).symlink_to("/dev/zero")
    refusal(capsys, *words.split())
    assert not list(here.glob("x*"))


@pytest.fixture
def full(tmp_path):
    """A file system of 64 KiB; skips where it cannot be mounted."""
    folder = tmp_path / "full"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(folder)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no right to mount a small file system")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_is_one_line(here, full, capsys):
    prune = ["prune", "a.ply", "--keep", "0.9", "-o", full / "a.ply", "--num-cameras", "2"]
    for words in (["demo", full / "demo"], prune):
        line = refusal(capsys, *words)
        assert "disk is full" in line
        assert str(full) in line
    for kind in ("ply", "spz", "sog"):
        (full / "rest").write_bytes(b"")
        room = os.statvfs(full)
        (full / "rest").write_bytes(bytes(max(room.f_bavail - 1, 0) * room.f_bsize))
        out = full / f"b.{kind}"
        assert str(out) in refusal(capsys, "export", "a.sundae", "-o", out)
        assert not out.exists()


PRINTING = pytest.mark.parametrize(("words", "unbuffered"), [("help", "1"), ("help", ""), ("info --help", "")])


def installed(words, unbuffered, **options):
    """The installed command in a process."""
    words = [Path(sys.executable).parent / "sundae", *words.split()]
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    return subprocess.Popen(words, stderr=subprocess.PIPE, env=environment, **options)


@PRINTING
def test_a_full_disk_behind_stdout_is_one_line(words, unbuffered):
    with open("/dev/full", "w") as nowhere, installed(words, unbuffered, stdout=nowhere) as process:
        (line,) = process.stderr.read().splitlines()
    assert b"disk is full" in line
    assert process.returncode == 2


@PRINTING
def test_a_reader_of_stdout_that_has_left_is_no_error(words, unbuffered):
    with installed(words, unbuffered, stdout=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 141


@pytest.mark.parametrize("words", ["help", "info --help"])
def test_a_closed_stdout_is_no_error(words):
    with installed(words, "", preexec_fn=partial(os.close, 1)) as process:
        assert process.stderr.read() == b""
    assert process.returncode == 0


@pytest.mark.parametrize("sent", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_no_half_of_a_file(here, sent):
    killed = f"import os, time; os.fsync = lambda _: (os.kill(os.getpid(), {sent:d}), time.sleep(600))"
    words = [sys.executable, "-c", f"{killed}; import sundae_ns.cli as it; it.main()", *"export a.ply -o b.spz".split()]
    done = subprocess.run(words, preexec_fn=partial(signal.signal, sent, signal.SIG_DFL), check=False)
    assert (done.returncode, sorted(path.name for path in here.iterdir())) == (128 + sent, ["a.ply", "a.sundae"])
