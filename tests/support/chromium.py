"""The modules of ``benchmarks`` that drive a Chromium and the Chromium that they find."""

from __future__ import annotations

import shutil
from typing import Any

import bench_page
import bench_viewers  # noqa: F401
import pytest

from harness import chromium as browser

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
