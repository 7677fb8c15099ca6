"""Options that commands share, and the one place that decides whether a command may write its output."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryFile
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from tyro.constructors import PrimitiveConstructorSpec

from sundae_ns.core.errors import ConfigError, StorageError

Source = Annotated[Path, tyro.conf.Positional]  # the file or the folder that a command reads
Scene = Annotated[
    Path,
    tyro.conf.Positional,
    tyro.conf.arg(
        help="a packed scene, a run (its folder or config.yml), or a .ply, .spz, .sog, .glb, .splat, .ksplat or "
        "gsplat's .pt."
    ),
]
Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]  # an option without a --no- form
Overwrite = Annotated[Flag, tyro.conf.arg(help="replace an earlier output, once the new one is complete.")]
Direction = tuple[float, float, float]


def _share(words: list[str]) -> float:
    value = float(words[0].removesuffix("%"))
    return value / 100 if words[0].endswith("%") else value


Share = Annotated[
    float,
    PrimitiveConstructorSpec(1, "SHARE", _share, lambda value: isinstance(value, float), lambda value: [f"{value:g}"]),
]
"""A share of the Gaussians: ``0.25`` or ``25%``."""


def progress_bar() -> Progress:
    """A bar on the terminal of stderr, which is gone at its end."""
    console = Console(file=sys.stderr)  # a command may redirect it afterwards
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    shown, both = console.is_terminal, sys.stdout.isatty()  # stdout may be a file
    return Progress(*columns, console=console, transient=True, disable=not shown, redirect_stdout=both)


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
    if not out.exists():
        return
    if any(_contains(out, path) for path in reads if path is not None):
        raise StorageError(f"{out} holds what the command reads; choose another folder")
    if not overwrite and any(out.iterdir()):
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
    suffix = out.suffix.lower()
    if suffix not in suffixes:
        raise ConfigError(f"{out} has no supported suffix; name it {', '.join(suffixes)}")
    return suffix


def check_least(**values: tuple[float | None, float]) -> None:
    """Raise ``ConfigError`` for the first option that is given and below its limit: ``steps=(steps, 1)``."""
    for name, (value, least) in values.items():
        if value is not None and not value >= least:
            raise ConfigError(f"{name.replace('_', '-')} is {value}; give at least {least}")


def check_exclusive(**values: object) -> None:
    """Raise ``ConfigError`` if more than one of the options is given."""
    given = [f"--{name.replace('_', '-')}" for name, value in values.items() if value is not None]
    if len(given) > 1:
        raise ConfigError(f"{given[0]} and {given[1]} exclude each other; give one")
