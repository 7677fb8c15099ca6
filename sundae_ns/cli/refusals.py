"""What commands refuse before they read or write, and the one place that decides whether one may write its output."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryFile

from sundae_ns.core.errors import ConfigError, StorageError


def check_file(out: Path, *, reads: Iterable[Path | None], overwrite: bool) -> None:
    """Raise ``StorageError`` for an output that is no file, that ``reads`` hold, or that exists; None reads nothing."""
    _check_writable(out.parent)
    if not out.exists():
        return
    if not out.is_file():
        raise StorageError(f"{out} is {'a folder' if out.is_dir() else 'no regular file'}; name a file to write")
    if any(_contains(path, out) for path in reads if path is not None):
        raise StorageError(f"{out} belongs to what the command reads; choose another name")
    if not overwrite:
        raise StorageError(f"{out} exists; choose another name, or replace it with --overwrite")


def check_folder(
    out: Path, *, reads: Iterable[Path | None], overwrite: bool | None = None, outside: Path | None = None
) -> None:
    """As :func:`check_file`, for a folder that an input, ``outside``, must not hold; ``overwrite`` may be no option."""
    if out.exists() and not out.is_dir():
        raise StorageError(f"{out} is a file; choose another folder")
    if outside is not None and _contains(outside, out):
        raise StorageError(f"{out} lies in {outside}, which the command reads; choose another folder")
    _check_writable(out)
    if any(_contains(out, path) for path in reads if path is not None):
        raise StorageError(f"{out} holds what the command reads; choose another folder")
    if not overwrite and out.exists() and any(out.iterdir()):
        replaced = "" if overwrite is None else ", or replace its files with --overwrite"
        raise StorageError(f"{out} holds files; choose another folder{replaced}")


def _check_writable(folder: Path) -> None:
    """Raise ``StorageError`` unless files can be made in a folder, or in the first one above that exists."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    if not folder.is_dir():
        raise StorageError(f"{folder} is no folder; choose another")
    try:
        TemporaryFile(dir=folder).close()
    except OSError as error:
        raise StorageError(f"cannot write to {folder.absolute()} ({error.strerror}); choose another folder") from error


def _contains(outer: Path, inner: Path) -> bool:
    """Whether a path is or holds another one; links count as what they point to."""
    return inner.resolve().is_relative_to(outer.resolve())


def check_suffix(out: Path, suffixes: Iterable[str]) -> str:
    """The suffix of an output in lower case; ``ConfigError`` for another one."""
    if (suffix := out.suffix.lower()) not in suffixes:
        raise ConfigError(f"{out} has no supported suffix; name it {', '.join(suffixes)}")
    return suffix


def check_least(**values: tuple[float | None, float]) -> None:
    """Raise ``ConfigError`` for the first option that is given and below its limit: ``steps=(steps, 1)``."""
    for name, (value, least) in values.items():
        if value is not None and not least <= value < float("inf"):
            raise ConfigError(f"{name.replace('_', '-')} is {value}; give {'less, ' * (value > least)}at least {least}")


def check_exclusive(**values: object) -> None:
    """Raise ``ConfigError`` if more than one of the options is given."""
    given = [f"--{name.replace('_', '-')}" for name, value in values.items() if value is not None]
    if len(given) > 1:
        raise ConfigError(f"{given[0]} and {given[1]} exclude each other; give one")
