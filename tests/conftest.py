"""Shared by all tests: seeds, threads, and the one place where GPU tests are skipped."""

from __future__ import annotations

import importlib
import os

import pytest
import torch


def pytest_configure() -> None:
    # Tests are small: a second thread gains little, and waits long where something else runs on the machine. Commands
    # that tests start inherit it, so that their sums come out as those of this process.
    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if torch.cuda.is_available():
        return
    skip = pytest.mark.skip(reason="no CUDA device here")
    for item in items:
        if "gpu" in item.keywords:
            item.add_marker(skip)


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def open3d() -> None:
    """Skips where open3d cannot be imported: it loads libraries of a desktop."""
    try:
        importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        pytest.skip(f"open3d does not import here: {error}")
