"""Options that commands share."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from tyro.constructors import PrimitiveConstructorSpec

from sundae_ns.cli.refusals import check_exclusive, check_least
from sundae_ns.core.errors import ConfigError
from sundae_ns.core.share import SHARE

T = TypeVar("T")
NO_DEFAULT = tyro.conf.arg(help_behavior_hint="")  # in the help


def _optional(kind: type[float], metavar: str) -> PrimitiveConstructorSpec[Any]:
    """How numbers that may be left out are read, one a word of the metavar: a union would name None beside them."""
    read = (lambda words: tuple(map(kind, words))) if " " in metavar else lambda words: kind(words[0])
    return PrimitiveConstructorSpec(len(metavar.split()), metavar, read, lambda _: True, lambda x: [str(x)])


Int = Annotated[int | None, _optional(int, "INT"), NO_DEFAULT]
Float = Annotated[float | None, _optional(float, "FLOAT"), NO_DEFAULT]
File = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]
Input = Annotated[Path, tyro.conf.Positional]  # the file or the folder that a command reads
_SCENES = "a packed scene or page, a run's folder, or a .ply, .spz, .sog, lod-meta.json, .glb, .splat, .ksplat or .pt."
Scene = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(help=_SCENES)]
Rest = Annotated[tuple[str, ...], tyro.conf.Positional, NO_DEFAULT, tyro.conf.arg(metavar="[-- OPTION ...]")]
Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]  # without a --no- form
Overwrite = Annotated[Flag, tyro.conf.arg(help="replace an earlier output, once the new one is complete.")]


@dataclass(frozen=True)
class Wishes:
    """What a scene is to be, in every command: in turn a box, no floaters, and a number of Gaussians or a size."""

    keep: Annotated[float | None, SHARE, NO_DEFAULT] = None
    """share of the Gaussians to keep, 0.25 or 25%."""
    count: Int = None
    """number of Gaussians to keep, in place of a share."""
    max_mb: Float = None
    """size of the finished file in MB, its head and the code of a page included, in place of a share."""
    crop: Annotated[tuple[float, ...] | None, _optional(float, "X Y Z X Y Z"), NO_DEFAULT] = None
    """keep the Gaussians whose centres are in this box, in the file's coordinates: lowest x y z, then highest."""
    remove_floaters: Annotated[Float, tyro.conf.arg(metavar="[0 to 1]")] = None
    """remove what floats, and what no camera of the photographs sees: from 0, what surely does, to 1; bare 0.25."""

    def check_wishes(self, **others: object) -> None:
        """Raise ``ConfigError`` for more than one amount, ``others`` included, or one that is out of range."""
        check_exclusive(keep=self.keep, count=self.count, max_mb=self.max_mb, **others)
        if self.keep is not None and not 0 < self.keep <= 1:
            raise ConfigError(f"keep is {self.keep}; give a share in (0, 1], or per cent as 25%")
        if not 0 <= (self.remove_floaters or 0) <= 1:
            raise ConfigError(f"remove-floaters is {self.remove_floaters}; give 0 (careful) to 1 (thorough)")
        check_least(count=(self.count, 1), max_mb=(self.max_mb, 0.001))

    @property
    def cleans(self) -> list[str]:
        """Words of the options that cut Gaussians by their place."""
        return words_of(self, "crop", "remove_floaters")

    @property
    def reduces(self) -> bool:
        """Whether an amount is given."""
        return (self.keep, self.count, self.max_mb) != (None, None, None)


@dataclass(frozen=True)
class Details:
    """Options that few need."""

    up: Annotated[tuple[float, float, float] | None, _optional(float, "X Y Z"), NO_DEFAULT] = None
    """direction that is upwards, for example 0 0 1; by default that of the scene, else of its cameras, else z."""
    start_view: Annotated[str | None, tyro.conf.arg(metavar="VIEW", help_behavior_hint="")] = None
    """what a page opens with: index of a stored camera, or a camera file; by default the scene's, else camera 0."""
    no_head: Flag = False
    """without the head: the scene is complete in viewers that have none."""
    seed: Int = None
    """seed of all random draws; by default 0, of a training 42."""


@dataclass(frozen=True)
class SceneDetails(Details):
    """Options that few need."""

    cameras: File = None
    """transforms.json, COLMAP model, camera path, run or pack, whose cameras replace the scene's or virtual ones."""
    data: File = None
    """folder of the capture of a run, if it moved."""
    preview: File = None
    """PNG to write: what the camera that --remove-floaters changes most sees before and after."""
    overwrite: Overwrite = False


Hidden = tyro.conf.Suppress[T]  # no option
Plain = Annotated[T, tyro.conf.arg(name="")]  # options among those of the command
Advanced = Annotated[T, tyro.conf.OmitArgPrefixes]  # options in a group of the help with the name of the parameter


def word(path: Path) -> str:
    """A path as a word of a command; one that begins with a dash would be taken for an option."""
    return f".{os.sep}{path}" if str(path).startswith("-") else str(path)


def words_of(options: Any, *names: str) -> list[str]:
    """Words of a command that give the named fields of a dataclass, those that differ from their defaults."""
    words: list[str] = []
    for field in fields(options):
        if field.name in names and (value := getattr(options, field.name)) != field.default:
            values = value if isinstance(value, tuple) else (value,)
            given = (word(each) if isinstance(each, Path) else str(each) for each in values)
            words += [f"--{field.name.replace('_', '-')}", *given]
    return words


def progress_bar() -> Progress:
    """A bar on the terminal of stderr, which is gone at its end."""
    console = Console(file=sys.stderr)  # a command may redirect it afterwards
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    tty = sys.stdout.isatty()  # it may be a file
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal, redirect_stdout=tty)
