"""The driver of ``benchmarks/browser.py`` as a module, and the Chromium that it finds."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

_spec = importlib.util.spec_from_file_location("browser", Path(__file__).parents[2] / "benchmarks" / "browser.py")
assert _spec is not None
assert _spec.loader is not None
browser = sys.modules["browser"] = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(browser)

CHROMIUM = browser.find_chromium()
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here (apt-get install chromium)")
