"""Options that commands share, and the one place that decides whether a command may write its output."""

from __future__ import annotations

import dataclasses
import sys
import types
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from sundae_ns.core.errors import ConfigError, StorageError

T = TypeVar("T")
SHORT = ConstructorRegistry()  # of options that may be left out: their help names the type, not None beside it


@SHORT.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> Any:
    kinds = get_args(info.type) if get_origin(info.type) in (Union, types.UnionType) else ()
    if len(kinds) != 2 or kinds[1] is not type(None):
        return None
    spec: Any = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], info.markers))
    return dataclasses.replace(
        spec,
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: [] if value is None else spec.str_from_instance(value),
    )


Maybe = Annotated[T | None, tyro.conf.arg(help_behavior_hint="")]  # an option that may be left out
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
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]  # without a --no- form
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


@dataclass(frozen=True)
class Wishes:
    """What a scene is to be, in every command: in turn a box, no floaters, and a number of Gaussians or a size."""

    keep: Maybe[Share] = None
    """share of the Gaussians to keep, 0.25 or 25%."""
    count: Maybe[int] = None
    """number of Gaussians to keep, in place of a share."""
    max_mb: Maybe[float] = None
    """size of the finished file in MB, its head and the code of a page included, in place of a share."""
    crop: Maybe[tuple[float, float, float, float, float, float]] = None
    """keep the Gaussians whose centres are in this box: its lowest x y z, then its highest, in the coordinates of the
    file."""
    remove_floaters: Flag = False
    """remove small groups of Gaussians that touch no other, and what none of the cameras of the photographs sees."""

    def check_wishes(self, **others: object) -> None:
        """Raise ``ConfigError`` for more than one amount, ``others`` included, or one that is out of range."""
        check_exclusive(keep=self.keep, count=self.count, max_mb=self.max_mb, **others)
        if self.keep is not None and not 0 < self.keep <= 1:
            raise ConfigError(f"keep is {self.keep}; give a share in (0, 1], or per cent as 25%")
        check_least(count=(self.count, 1), max_mb=(self.max_mb, 0.001))

    @property
    def cleans(self) -> str:
        """Name of the first option that cuts Gaussians by their place, or empty."""
        floaters = "--remove-floaters" if self.remove_floaters else ""
        return floaters if self.crop is None else "--crop"

    @property
    def reduces(self) -> bool:
        """Whether an amount is given."""
        return (self.keep, self.count, self.max_mb) != (None, None, None)


@dataclass(frozen=True)
class Details:
    """Options that few need."""

    up: Maybe[Direction] = None
    """direction that is upwards, for example 0 0 1; by default that of the scene, else of its cameras, else z."""
    start_view: Maybe[str] = None
    """what a page opens with: index of a stored camera, or a camera file; by default that of the scene, else the first
    camera."""
    no_head: Flag = False
    """without the head: the scene is complete in viewers that have none."""
    seed: Maybe[int] = None
    """seed of all random draws; by default 0, of a training 42."""


@dataclass(frozen=True)
class SceneDetails(Details):
    """Options that few need."""

    cameras: Maybe[Path] = None
    """a transforms.json, a COLMAP model (sparse/0), a camera path, a run or a packed scene, whose cameras are taken in
    place of those of the scene, or of virtual ones."""
    data: Maybe[Path] = None
    """folder of the capture of a run, if it moved."""
    overwrite: Overwrite = False


Plain = Annotated[T, tyro.conf.arg(name="")]  # options among those of the command
Advanced = Annotated[T, tyro.conf.OmitArgPrefixes]  # options in a group of the help with the name of the parameter


def words_of(options: object, *names: str) -> list[str]:
    """Words of a command that give some fields of a dataclass, those that are not left out."""
    words: list[str] = []
    for name in names:
        value, flag = getattr(options, name), f"--{name.replace('_', '-')}"
        if value is True:
            words.append(flag)
        elif value is not None and value is not False:
            words += [flag, *(f"{each:g}" if isinstance(each, float) else str(each) for each in _listed(value))]
    return words


def _listed(value: object) -> tuple[object, ...]:
    return value if isinstance(value, tuple) else (value,)


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


def check_drop(decibels: float | None) -> None:
    """Raise ``ConfigError`` for a loss of PSNR that is no positive number of dB."""
    if decibels is not None and not 0 < decibels < 100:
        raise ConfigError(f"target-drop is {decibels}; give a positive number of dB, 0.5 for half a decibel")


def check_exclusive(**values: object) -> None:
    """Raise ``ConfigError`` if more than one of the options is given."""
    given = [f"--{name.replace('_', '-')}" for name, value in values.items() if value is not None]
    if len(given) > 1:
        raise ConfigError(f"{given[0]} and {given[1]} exclude each other; give one")
