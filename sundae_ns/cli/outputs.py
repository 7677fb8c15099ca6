"""The one place that decides whether a command may write its output."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import tyro

from sundae_ns.errors import StorageError

Overwrite = Annotated[bool, tyro.conf.FlagCreatePairsOff]
"""The option ``--overwrite`` of every command that writes."""


def check_file(out: Path, *, reads: Iterable[Path | None], overwrite: bool) -> None:
    """Refuse an output file that exists, unless ``overwrite`` is set, and always one that the command reads.

    Args:
        out: file to write; a missing folder of it is made when the file is written.
        reads: files and folders that the command reads; None for an option that was not given.
        overwrite: whether a file that the command does not read may be replaced.

    Raises:
        StorageError: the file may not be written.
    """
    above = out.parent
    while not above.exists() and above != above.parent:
        above = above.parent
    if not above.is_dir():
        raise StorageError(f"{above} is no folder; choose another")
    if not out.exists():
        return
    if not out.is_file():
        raise StorageError(f"{out} is {'a folder' if out.is_dir() else 'no regular file'}; name a file to write")
    if any(_contains(path, out) for path in reads if path is not None):
        raise StorageError(f"{out} belongs to what the command reads; choose another name")
    if not overwrite:
        raise StorageError(f"{out} exists; choose another name, or replace it with --overwrite")


def check_folder(out: Path, *, reads: Iterable[Path | None], overwrite: bool) -> None:
    """Refuse an output folder with files, unless ``overwrite`` is set, and always one that holds an input.

    Args:
        out: folder to write; files of other names in it stay.
        reads: as in :func:`check_file`.
        overwrite: whether files in it may be replaced.

    Raises:
        StorageError: the folder may not be written.
    """
    if not out.exists():
        return
    if not out.is_dir():
        raise StorageError(f"{out} is a file; choose another folder")
    if any(_contains(out, path) for path in reads if path is not None):
        raise StorageError(f"{out} holds what the command reads; choose another folder")
    if not overwrite and any(out.iterdir()):
        raise StorageError(f"{out} holds files; choose another folder, or replace its files with --overwrite")


def _contains(outer: Path, inner: Path) -> bool:
    """Whether a path is another one, or lies in that folder; links count as what they point to."""
    return inner.resolve().is_relative_to(outer.resolve())
