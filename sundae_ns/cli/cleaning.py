"""Options of ``sundae prune``, ``pack`` and ``export`` that cut a scene before it is published."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from torch import Tensor

    from sundae_ns.api.scene import Scene
    from sundae_ns.rendering import View


@dataclass(frozen=True)
class Cleaning:
    """What to cut, before anything else."""

    crop: tuple[float, float, float, float, float, float] | None = None
    """keep the primitives whose centres are in this box: its lowest x y z, then its highest, in the coordinates of the
    scene."""
    remove_floaters: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """remove small groups of primitives that touch no other, and what none of the cameras of the photographs sees."""

    @property
    def chosen(self) -> list[str]:
        """Names of the options that are given."""
        given = {"--crop": self.crop is not None, "--remove-floaters": self.remove_floaters}
        return [name for name, is_given in given.items() if is_given]

    def mask(self, scene: Scene, views: Sequence[View], *, progress: bool = True) -> Tensor:
        """True for primitives that stay, bool ``[N]``; prints their numbers to stderr.

        Args:
            scene: to clean.
            views: cameras of the photographs; none if they are not known.
            progress: show a progress bar on stderr.

        Raises:
            ConfigError: the box is empty.
            DataError: nothing is left.
        """
        import torch
        from rich.console import Console

        from sundae_ns.api.cleaning import crop_mask, floater_mask, kept
        from sundae_ns.errors import DataError

        mask = torch.ones(scene.num_primitives, dtype=torch.bool, device=scene.device)
        if self.crop is not None:
            mask = crop_mask(scene, self.crop[:3], self.crop[3:])
            print(f"{int(mask.sum()):,} of {len(mask):,} primitives are in the box", file=sys.stderr)
        if self.remove_floaters:
            left = int(mask.sum())
            console = Console(stderr=True) if progress else None
            floats = floater_mask(kept(scene, mask), views, console=console)
            mask[mask.clone()] = ~floats
            rule = "" if views else ", by their neighbours alone: no camera of the photographs is known"
            print(f"removed {int(floats.sum()):,} floaters of {left:,} primitives{rule}", file=sys.stderr)
            if not bool(mask.any()):
                raise DataError("all primitives float; leave out --remove-floaters")
        return mask

    def cleaned(self, scene: Scene, *, progress: bool = True) -> Scene:
        """The scene without what :meth:`mask` cuts, by the views that are stored with it."""
        from sundae_ns.api.cleaning import kept

        return kept(scene, self.mask(scene, scene.views, progress=progress)) if self.chosen else scene
