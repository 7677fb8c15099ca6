"""Compilation of loops: cached on disk, renewed when a constant changes, and announced when it takes long."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numba
import pytest

from sundae_ns.rasterization.cpu import parallel

LOOP = """
import numpy as np
from sizes_of_this_test import SIZE
from sundae_ns.rasterization.cpu.parallel import compiled, parallel_for

@compiled
def loop(begin, end, out):
    for i in range(begin, end):
        out[i] = SIZE

out = np.zeros(3)
parallel_for(loop, 3, out)
"""


def test_cached_code_is_renewed_when_a_constant_of_another_module_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "loop.py"
    source.write_text(LOOP)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))

    def run(size: int) -> tuple[list[float], int]:
        module = ModuleType("sizes_of_this_test")
        module.SIZE = size  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "sizes_of_this_test", module)
        made: dict[str, Any] = {"__name__": "loop"}
        exec(compile(LOOP, str(source), "exec"), made)
        return made["out"].tolist(), sum(made["loop"].stats.cache_hits.values())

    assert run(1) == ([1.0, 1.0, 1.0], 0)
    assert run(1) == ([1.0, 1.0, 1.0], 1)
    assert run(2) == ([2.0, 2.0, 2.0], 0)


def test_compiles_without_a_cache_folder() -> None:
    """numba finds no folder for a function without a file, as if neither package nor home were writable."""
    made: dict[str, Any] = {}
    exec(compile("def double(x):\n    return 2 * x", "<nowhere>", "exec"), made)
    assert parallel.compiled(made["double"])(4) == 8


def test_a_notice_is_printed_for_long_compilation(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    parallel._print_once.cache_clear()
    monkeypatch.setattr(parallel, "_NOTICE_AFTER", 0.05)
    monkeypatch.setattr(parallel, "_ready", set())

    class Loop:
        """As numba's: it counts the calls that found no code on disk."""

        def __init__(self, seconds: float, misses: int) -> None:
            self.seconds, self.stats = seconds, SimpleNamespace(cache_misses={"types": misses} if misses else {})

        def __call__(self, begin: int, end: int) -> None:
            time.sleep(self.seconds if begin == end else 0.0)

    slow = Loop(0.5, misses=1)
    for quiet in (Loop(0.0, misses=1), Loop(0.5, misses=0)):
        parallel.parallel_for(quiet, 3)
        assert capsys.readouterr().err == ""
    parallel.parallel_for(slow, 3)
    (line,) = capsys.readouterr().err.splitlines()
    assert "compiling" in line
    parallel._ready.clear()
    parallel.parallel_for(slow, 3)
    parallel.parallel_for(slow, 3)
    assert capsys.readouterr().err == ""
