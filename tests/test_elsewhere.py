"""Elsewhere: Windows, as far as Linux can tell, and a folder in which an editor looks at a user's program."""

import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import forked

ROOT = Path(__file__).parents[1]
BUILD = "import sys; from setuptools import build_meta; build_meta.build_editable(sys.argv[1])"
PROGRAM = """import sundae_ns as sn

scene = sn.load("garden.ply")
small = sn.prune(scene, keep=0.1, cameras=sn.virtual_cameras(scene, n=16))
image = sn.render(small, sn.Camera.look_at((0, -3, 1), (0, 0, 0), width=64)).rgb
sn.save(small, "small.sundae", {})
"""
POSIX_MODULES = ("fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty")
IMPORTER = """
import importlib, os, pkgutil, signal, sys, sundae_ns

def load():
    for info in pkgutil.walk_packages(sundae_ns.__path__, "sundae_ns."):
        importlib.import_module(info.name)

load()  # libraries of others import what they need of this system
for name in [name for name in sys.modules if name.startswith("sundae_ns.")]:
    del sys.modules[name]
for name in sys.argv[1:]:
    sys.modules[name] = None
for name in ("killpg", "getpgid", "setsid", "fork", "getuid", "geteuid", "sched_getaffinity", "statvfs", "sysconf"):
    delattr(os, name)
for name in ("SIGHUP", "SIGKILL", "SIGALRM", "SIGUSR1", "SIGXFSZ", "alarm", "pause", "setitimer"):
    delattr(signal, name)
for name in [name for name in vars(os) if name in ("O_NOFOLLOW", "O_DIRECTORY", "O_NONBLOCK", "O_SYNC")]:
    delattr(os, name)
sys.platform = "win32"
load()
print(sum(name.startswith("sundae_ns.") for name in sys.modules))
"""


def test_every_module_is_imported_without_what_only_posix_has(tmp_path):
    (tmp_path / "importer.py").write_text(IMPORTER)
    code, printed = forked.run(tmp_path / "importer.py", *POSIX_MODULES)
    assert code == 0, printed
    assert int(printed.split()[-1]) > 100


def test_an_editor_finds_the_types_of_an_editable_install(tmp_path):
    source = tmp_path / "source"
    for name in ("sundae_ns", "method_configs"):
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, source)
    subprocess.run([sys.executable, "-c", BUILD, tmp_path], cwd=source, capture_output=True, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    venv.create(tmp_path / "venv")
    (packages,) = tmp_path.glob("venv/lib/*/site-packages")
    zipfile.ZipFile(wheel).extractall(packages)
    for name, option in (("right.py", "upright=True"), ("wrong.py", "uprigth=True")):
        (tmp_path / name).write_text(PROGRAM.format(option))
    python = tmp_path / "venv" / "bin" / "python"
    check = [sys.executable, "-m", "mypy", "--strict", "--python-executable", python, "right.py", "wrong.py"]
    done = subprocess.run(check, cwd=tmp_path, env={}, capture_output=True, text=True, check=False)
    (error,) = (line for line in done.stdout.splitlines() if ": error: " in line)
    assert error.startswith("wrong.py:"), done.stdout + done.stderr
    assert 'Unexpected keyword argument "uprigth"' in error
