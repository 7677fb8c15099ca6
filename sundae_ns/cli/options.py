"""Options that commands share."""

from __future__ import annotations

import dataclasses
import sys
import types
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from sundae_ns.cli.refusals import check_exclusive, check_least
from sundae_ns.core.errors import ConfigError

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
        help="a packed scene or its page (.html), a run (its folder or config.yml), or a .ply, .spz, .sog, "
        "lod-meta.json, .glb, .splat, .ksplat or gsplat's .pt."
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
    remove_floaters: Annotated[Maybe[float], tyro.conf.arg(metavar="[0 to 1]")] = None
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
    def cleans(self) -> str:
        """Name of the first option that cuts Gaussians by their place, or empty."""
        floaters = "" if self.remove_floaters is None else "--remove-floaters"
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
            values = value if isinstance(value, tuple) else (value,)
            words += [flag, *(f"{each:g}" if isinstance(each, float) else str(each) for each in values)]
    return words


def progress_bar() -> Progress:
    """A bar on the terminal of stderr, which is gone at its end."""
    console = Console(file=sys.stderr)  # a command may redirect it afterwards
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    shown, both = console.is_terminal, sys.stdout.isatty()  # stdout may be a file
    return Progress(*columns, console=console, transient=True, disable=not shown, redirect_stdout=both)
