"""Errors shown to users in one line, cause and remedy; each is also the built-in exception that a caller expects."""

from __future__ import annotations

import errno
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType

STOPPED = (130, 143)  # exit codes of a training that SIGINT or SIGTERM stopped, and that has saved itself
NOTHING_SAVED = "Stopped before the first step: nothing to save."
passed_on: list[int] = []  # signals that this process passed on to its ranks, in their order
_REASONS = {
    errno.ENOSPC: "the disk is full; make room",
    errno.EDQUOT: "the disk quota is used up; make room",
    errno.EFBIG: "the file is larger than this process may write; raise the limit (ulimit -f)",
    errno.EROFS: "the file system is read-only; choose another folder",
    **dict.fromkeys((errno.EACCES, errno.EPERM), "permission denied; choose another folder, or change its permissions"),
    **dict.fromkeys((errno.ENOTDIR, errno.EEXIST), "a file stands where a folder should be; choose another folder"),
    errno.EIO: "the disk reports an error; check it, or choose another disk",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
    errno.EISDIR: "it is a folder; name a file",
    errno.ENOENT: "a file or a folder is missing; check the path",
}
# First bytes of files that stand in for one that was not fetched.
_STAND_INS = {b"version https://git-lfs": "is a pointer of Git LFS; fetch the file itself with `git lfs pull`"}
_STAND_INS |= dict.fromkeys((b"<!doctype html", b"<html"), "is a web page; download the file that it shows or names")


class SundaeError(Exception):
    """Base class of all errors that ``sundae_ns`` raises on purpose."""

    def __str__(self) -> str:  # one line, although names of files may have others
        return re.sub(r"[\0-\x1f\x7f]", lambda odd: repr(odd[0])[1:-1], super().__str__())


class ConfigError(SundaeError, ValueError):
    """An option has an invalid value, or two options contradict each other."""


class DataError(SundaeError, ValueError):
    """Input data (images, cameras, point clouds, Gaussians) is unusable."""


class BackendError(SundaeError, RuntimeError):
    """The requested rasteriser or device is not available."""


class StorageError(SundaeError, OSError):
    """A file cannot be written: the disk is full or permission is denied."""


class PackError(SundaeError, ValueError):
    """A packed scene is damaged or of another version, or a scene cannot be packed."""


class MemoryExhaustedError(SundaeError, RuntimeError):
    """The device lacks memory for the scene or the image, or a view has more Gaussians than any real scene."""


class CheckpointError(SundaeError, ValueError):
    """A checkpoint does not fit the model. Not a ``RuntimeError``, on which nerfstudio retries without strictness."""


@contextmanager
def writing(failure: str) -> Iterator[None]:
    """Turn file-system errors that a user can correct into ``StorageError``, whose message starts with ``failure``."""
    try:
        yield
    except Exception as error:
        cause: BaseException | None = error
        # torch and zipfile replace a failed write by an error of their own when they close the file.
        while cause is not None and not isinstance(cause, (OSError, SundaeError)):
            cause = cause.__cause__ or cause.__context__
        if (number := getattr(cause, "errno", None)) not in _REASONS:
            raise
        raise StorageError(f"{failure}: {_REASONS[number]}") from error


@contextmanager
def reading(
    path: Path,
    kind: str,
    failure: type[SundaeError] = DataError,
    *,
    remedy: str = "export it again",
    missing: str = "check the path",
) -> Iterator[None]:
    """Turn every error of reading an untrusted file of a ``kind`` into a ``failure``; decoders raise many kinds."""
    try:
        yield
    except SundaeError:
        raise
    except Exception as error:
        reason = getattr(error, "strerror", None) or one_line(error)
        of_system = isinstance(error, OSError) and error.errno
        what = f"cannot be read ({reason}); {missing}" if of_system else f"is not {kind} ({reason}); {remedy}"
        with suppress(OSError, ValueError), regular(path).open("rb") as file:
            first = file.read(32).lower()
            what = next((other for begin, other in _STAND_INS.items() if first.startswith(begin)), what)
        if isinstance(error, MemoryError) or "DefaultCPUAllocator" in reason:
            raise MemoryExhaustedError(f"the memory is full with {path} ({reason}); end other programs") from error
        raise failure(f"{path} {what}") from error


def one_line(error: BaseException) -> str:
    """Message of an error in one line of at most 200 characters; the name of its class if it has none."""
    return " ".join(str(error).split())[:200] or type(error).__name__


def regular(path: Path) -> Path:
    """The path; ``OSError`` for a pipe, a socket or a device, whose reading may never end."""
    if path.exists() and not path.is_file() and not path.is_dir():
        raise OSError(errno.EINVAL, "it is a pipe or a device, not a file", str(path))
    return path


def rank_ended(error: BaseException) -> str:
    """Cause and remedy of a rank's end, which stopped the others, from an exception of ``torch.multiprocessing``."""
    rank, signal = getattr(error, "error_index", 0), getattr(error, "signal_name", None)
    if (last := (str(error).strip().splitlines() or [""])[-1]).startswith(__name__ + "."):
        return f"rank {rank}: {last.partition(': ')[2]}"  # our own errors already name the remedy
    remedy = "resume from the newest checkpoint with --load-dir, on fewer GPUs with a smaller --machine.num-devices"
    return f"rank {rank} ended ({f'killed by {signal}' if signal else last}) and stopped the others; {remedy}"


def out_of_memory(error: BaseException, num_gaussians: int) -> MemoryExhaustedError:
    """The error for a full CUDA device: the number of Gaussians, the allocation that failed, and what to try."""
    allocation = re.search(r"[Tt]ried to allocate ([\d.]+ \w+)", str(error))
    return MemoryExhaustedError(
        f"the GPU's memory is full: cannot allocate {f'{allocation[1]} ' if allocation else ''}more with "
        f"{num_gaussians:,} Gaussians; try --pipeline.datamanager.cache-images cpu (images in host memory), "
        "--pipeline.datamanager.camera-res-scale-factor 0.5 (smaller images), or "
        "--pipeline.model.pruning.mode continuous --pipeline.model.pruning.keep-ratio 0.5 "
        f"--pipeline.model.pruning.max-gaussians {max(num_gaussians // 2, 1)} (a lower peak); "
        "--load-dir resumes from the last checkpoint"
    )


def show_in_one_line() -> None:
    """In an ``ns-*`` command without ``SUNDAE_TRACEBACK``, print our errors in one line and end Ctrl-C with 130."""
    if not Path(sys.argv[0]).name.startswith("ns-") or os.environ.get("SUNDAE_TRACEBACK"):
        return
    before = sys.excepthook

    def hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        of_rank = kind.__name__ in ("ProcessExitedException", "ProcessRaisedException")
        code, signal = getattr(error, "exit_code", None), getattr(error, "signal_name", None)
        if issubclass(kind, KeyboardInterrupt):
            print("\nStopped.", file=sys.stderr)
            raise SystemExit(130)
        if code in STOPPED:  # the rank that ended first has printed the rest
            raise SystemExit(code)
        if code is not None and passed_on and signal in (None, "SIGINT", "SIGTERM"):
            print(f"\n{NOTHING_SAVED}", file=sys.stderr)
            raise SystemExit(128 + passed_on[0])
        if isinstance(error, SundaeError) or of_rank:
            print(f"sundae: {rank_ended(error) if of_rank else error}", file=sys.stderr)
        else:
            before(kind, error, trace)

    sys.excepthook = hook
