"""Errors shown to users: one line each, the cause first and then the remedy.

All derive from :class:`SundaeError`, so the command line can print them without a traceback. Each also derives from the
built-in exception that a caller would expect. This module imports nothing of the package.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from types import TracebackType

STOPPED = (130, 143)
"""Exit codes of a training that SIGINT or SIGTERM stopped, and that has saved itself."""


class SundaeError(Exception):
    """Base class of all errors that ``sundae_ns`` raises on purpose."""


class ConfigError(SundaeError, ValueError):
    """An option has an invalid value, or two options contradict each other."""


class DataError(SundaeError, ValueError):
    """Input data (images, cameras, point clouds, primitives) is unusable."""


class BackendError(SundaeError, RuntimeError):
    """The requested rasteriser or device is not available."""


class StorageError(SundaeError, OSError):
    """A file cannot be written: the disk is full or permission is denied."""


class PackError(SundaeError, ValueError):
    """A packed scene is damaged or of another version, or a field cannot be packed."""


class MemoryExhaustedError(SundaeError, RuntimeError):
    """The device lacks memory for the field or the image."""


class CheckpointError(SundaeError, ValueError):
    """A checkpoint does not fit the model.

    A ``ValueError``, because nerfstudio retries without strictness when loading raises a ``RuntimeError``.
    """


class RankError(SundaeError, RuntimeError):
    """One of the processes that train a scene together ended early."""


def rank_ended(error: BaseException) -> RankError:
    """The error for a rank that ended and stopped the others: which rank, why, and how to resume.

    Args:
        error: ``ProcessExitedException`` or ``ProcessRaisedException`` of ``torch.multiprocessing``.
    """
    rank, signal = getattr(error, "error_index", 0), getattr(error, "signal_name", None)
    last = (str(error).strip().splitlines() or [""])[-1]
    kind, _, message = last.partition(": ")
    if kind.startswith(__name__ + "."):
        return RankError(f"rank {rank}: {message}")  # our own errors already name the remedy
    cause = f"killed by {signal}" if signal else last
    return RankError(
        f"rank {rank} ended ({cause}) and stopped the others; resume from the newest checkpoint with --load-dir, "
        "on fewer GPUs with a smaller --machine.num-devices"
    )


def out_of_memory(error: BaseException, primitives: int) -> MemoryExhaustedError:
    """The error for a full CUDA device: the number of primitives, the allocation that failed, what to try.

    Args:
        error: ``torch.cuda.OutOfMemoryError``; its message states the size of the allocation.
        primitives: number of primitives in the field.
    """
    found = re.search(r"[Tt]ried to allocate ([\d.]+ \w+)", str(error))
    asked = f"cannot allocate {found[1]} more" if found else "cannot allocate more"
    return MemoryExhaustedError(
        f"the GPU's memory is full: {asked} with {primitives:,} primitives; "
        "try --pipeline.datamanager.cache-images cpu "
        "(images in host memory), --pipeline.datamanager.camera-res-scale-factor 0.5 (smaller images), or "
        "--pipeline.model.pruning.mode continuous --pipeline.model.pruning.keep-ratio 0.5 "
        f"--pipeline.model.pruning.max-primitives {max(primitives // 2, 1)} (a lower peak); "
        "--load-dir resumes from the last checkpoint"
    )


def show_in_one_line() -> None:
    """In a nerfstudio command (``ns-*``), end an uncaught :class:`SundaeError` with one line on stderr, and Ctrl-C with 130.

    Other errors, other programs, and all errors when ``SUNDAE_TRACEBACK`` is set are shown as before.
    """
    if not Path(sys.argv[0]).name.startswith("ns-") or os.environ.get("SUNDAE_TRACEBACK"):
        return
    before = sys.excepthook

    def hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if issubclass(kind, KeyboardInterrupt):
            print("\nStopped.", file=sys.stderr)
            raise SystemExit(130)
        code = getattr(error, "exit_code", None)  # of the rank that ended first; it has said the rest
        if code in STOPPED:
            raise SystemExit(code)
        if kind.__name__ in ("ProcessExitedException", "ProcessRaisedException"):
            error = rank_ended(error)
        if isinstance(error, SundaeError):
            print(f"sundae: {error}", file=sys.stderr)
        else:
            before(kind, error, trace)

    sys.excepthook = hook
