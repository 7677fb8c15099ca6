"""The errors that users see: one line each, the cause first and then the mend.

All derive from :class:`SundaeError`, so that the command line can show them without a traceback. Each also derives from
the built-in exception that callers would catch anyway. Floor 0: imports nothing of the package.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from types import TracebackType


class SundaeError(Exception):
    """Base class of every error raised on purpose by ``sundae_ns``."""


class ConfigError(SundaeError, ValueError):
    """An option has a value that cannot work, or two options contradict each other."""


class DataError(SundaeError, ValueError):
    """Input data (images, cameras, point clouds, primitives) cannot be used."""


class BackendError(SundaeError, RuntimeError):
    """A rasteriser or device was asked for that is not available here."""


class StorageError(SundaeError, OSError):
    """A file cannot be written: no room, or no right to."""


class PackError(SundaeError, ValueError):
    """A packed scene is damaged, of another version, or a field cannot be packed."""


class MemoryExhaustedError(SundaeError, RuntimeError):
    """The device has not enough memory for the field or the picture."""


class CheckpointError(SundaeError, ValueError):
    """A checkpoint does not fit the model.

    A ``ValueError`` on purpose: ``nerfstudio`` retries non-strictly when loading raises a ``RuntimeError``.
    """


class RankError(SundaeError, RuntimeError):
    """One of the processes that train one scene together has ended before its time."""


def rank_ended(error: BaseException) -> RankError:
    """The error for a rank that has ended and has taken the others with it: which, why, and how to go on.

    Args:
        error: ``ProcessExitedException`` or ``ProcessRaisedException`` of ``torch.multiprocessing``.
    """
    rank, signal = getattr(error, "error_index", 0), getattr(error, "signal_name", None)
    last = (str(error).strip().splitlines() or [""])[-1]
    kind, _, said = last.partition(": ")
    if kind.startswith(__name__ + "."):
        return RankError(f"rank {rank}: {said}")  # an error of ours: it says what to do
    cause = f"killed by {signal}" if signal else last
    return RankError(
        f"rank {rank} has ended ({cause}), and so the others were ended; go on from the newest checkpoint with --load-dir, "
        "on fewer GPUs with a smaller --machine.num-devices"
    )


def out_of_memory(error: BaseException, primitives: int) -> MemoryExhaustedError:
    """The error for a CUDA device without room: how many primitives there were, what was asked for, what to try.

    Args:
        error: ``torch.cuda.OutOfMemoryError``; its message states the size.
        primitives: of the field, when it happened.
    """
    found = re.search(r"[Tt]ried to allocate ([\d.]+ \w+)", str(error))
    asked = f"{found[1]} more were asked for" if found else "more was asked for than there is"
    return MemoryExhaustedError(
        f"the GPU's memory is full: {asked}, with {primitives:,} primitives; try --pipeline.datamanager.cache-images cpu "
        "(pictures in host memory), --pipeline.datamanager.camera-res-scale-factor 0.5 (smaller pictures), or "
        "--pipeline.model.pruning.mode continuous --pipeline.model.pruning.keep-ratio 0.5 "
        f"--pipeline.model.pruning.max-primitives {max(primitives // 2, 1)} (a lower peak); "
        "--load-dir goes on from the last checkpoint"
    )


def show_in_one_line() -> None:
    """Inside a command of nerfstudio (``ns-*``), let an uncaught error of ours end it with one line on stderr.

    Other errors, other programs, and everything where ``SUNDAE_TRACEBACK`` is set, are shown as before.
    """
    if not Path(sys.argv[0]).name.startswith("ns-") or os.environ.get("SUNDAE_TRACEBACK"):
        return
    before = sys.excepthook

    def hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if kind.__name__ in ("ProcessExitedException", "ProcessRaisedException"):
            error = rank_ended(error)
        if isinstance(error, SundaeError):
            print(f"sundae: {error}", file=sys.stderr)
        else:
            before(kind, error, trace)

    sys.excepthook = hook
