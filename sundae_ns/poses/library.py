"""pycolmap, which only poses need, and its settings for all stages."""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
import threading
from typing import Any

from sundae_ns.errors import ConfigError

INSTALL = 'pip install "sundae_ns[photos]"'
"""Command that installs the extra of this package."""
MISSING = f"camera poses need pycolmap; install it with {INSTALL}"
LARGEST = 1600
"""Longest side in pixels at which features are looked for, as that of training images."""
SEED = 0
"""Of the random choices of COLMAP, so that the same photos give the same poses on the same machine."""


def pycolmap() -> Any:
    """The module, with its log of progress turned off; ``ConfigError`` if it is not installed or cannot be loaded.

    The main thread imports it first: its library takes over SIGTERM, to print the stack where the process ends.
    """
    before = signal.getsignal(signal.SIGTERM)
    try:
        import pycolmap as module
    except ImportError as error:
        if isinstance(error, ModuleNotFoundError) and error.name == "pycolmap":
            raise ConfigError(MISSING) from error
        raise ConfigError(f"pycolmap cannot be loaded ({error}); install it again with {INSTALL}") from error
    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
    module.logging.minloglevel = module.logging.Level.FATAL.value
    return module


def check_installed() -> None:
    """Raise ``ConfigError`` if pycolmap is not installed; imports nothing."""
    loaded = "pycolmap" in sys.modules
    if sys.modules.get("pycolmap") is None if loaded else importlib.util.find_spec("pycolmap") is None:
        raise ConfigError(MISSING)


def threads() -> int:
    """Number of threads: that of the machine's processors, or ``OMP_NUM_THREADS``."""
    stated = os.environ.get("OMP_NUM_THREADS", "")
    return int(stated) if stated.isdigit() and int(stated) > 0 else (os.cpu_count() or 1)
