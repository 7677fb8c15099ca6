"""pycolmap: loaded silently, or one line that says how to install it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from fake_colmap import FakeColmap

from sundae_ns.errors import ConfigError
from sundae_ns.poses.library import check_installed, pycolmap, threads


def test_its_log_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeColmap()
    monkeypatch.setitem(sys.modules, "pycolmap", fake)  # type: ignore[arg-type]
    check_installed()
    assert pycolmap() is fake
    assert fake.logging.minloglevel == 3


def test_a_missing_package_and_a_broken_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    for load in (check_installed, pycolmap):
        with pytest.raises(ConfigError, match=r"need pycolmap; install it with pip install \"sundae_ns\[photos\]\""):
            load()
    (tmp_path / "pycolmap.py").write_text("raise ImportError('libgomp.so.1: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pycolmap")
    check_installed()
    with pytest.raises(ConfigError, match=r"pycolmap cannot be loaded \(libgomp.*; install it again with"):
        pycolmap()


LOUD = """
import signal, sys
from types import SimpleNamespace as Names
signal.signal(signal.SIGTERM, lambda *_: sys.exit("a stack of thirty lines"))
logging = Names(minloglevel=0, Level=Names(FATAL=Names(value=3)))
"""
TOLD = """
import os, signal
from sundae_ns.poses.library import pycolmap
pycolmap()
os.kill(os.getpid(), signal.SIGTERM)
"""


@pytest.mark.parametrize("real", [False, True])
def test_a_process_that_is_told_to_end_prints_nothing(tmp_path: Path, real: bool) -> None:
    if real:
        pytest.importorskip("pycolmap")
    else:
        (tmp_path / "pycolmap.py").write_text(LOUD)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *filter(None, sys.path)])}
    done = subprocess.run([sys.executable, "-c", TOLD], capture_output=True, text=True, env=environment, check=False)
    assert (done.returncode, done.stderr) == (-signal.SIGTERM, "")


@pytest.mark.parametrize(("stated", "count"), [("3", 3), ("1", 1), ("0", None), ("", None), ("many", None)])
def test_threads(monkeypatch: pytest.MonkeyPatch, stated: str, count: int | None) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", stated)
    assert threads() == (count or os.cpu_count())
