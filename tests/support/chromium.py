"""The modules of ``benchmarks`` that drive a Chromium and the Chromium that they find."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from harness import chromium as browser


def _script(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, Path(__file__).parents[2] / "benchmarks" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


bench_page = _script("bench_page")
bench_viewers = _script("bench_viewers")  # imports the one before

CHROMIUM = browser.find_chromium()
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here (apt-get install chromium)")
needs_packages = pytest.mark.skipif(not bench_page.has_packages(), reason="web/tests has no packages (make browser)")
needs_node = pytest.mark.skipif(
    shutil.which("node") is None or not (bench_page.WEB / "node_modules").is_dir(),
    reason="the page's build tools are not installed (make web)",
)


def touch(page: Any, at: tuple[int, int], to: tuple[int, int]) -> None:
    """Drag one finger."""
    page.call("Emulation.setTouchEmulationEnabled", {"enabled": True})
    points = [tuple(a + (b - a) * i / 4 for a, b in zip(at, to, strict=True)) for i in range(5)]
    for i, (x, y) in enumerate(points):
        event = {"type": "touchMove" if i else "touchStart", "touchPoints": [{"x": x, "y": y}]}
        page.call("Input.dispatchTouchEvent", event)
    page.call("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
