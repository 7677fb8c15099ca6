"""``sundae info``: what a file holds, and what cameras see of it."""

from __future__ import annotations

from json import dumps
from typing import Any

from rich.console import Console

from sundae_ns.cli.inputs import chosen_cameras
from sundae_ns.cli.options import File, Flag, Scene
from sundae_ns.core.tables import without_nan
from sundae_ns.rasterize.interface import fastest_device
from sundae_ns.scene.describe import describe
from sundae_ns.scene.load_save import load


def info(scene: Scene, cameras: File = None, json: Flag = False) -> int:
    """Say what a scene holds: Gaussians, bounds, marks, bytes, what cameras do not see, likely floaters, a crop box.

    Args:
        cameras: a transforms.json, a COLMAP model (sparse/0), a camera path, a run or packed scene, for its own.
        json: print one JSON object.
    """
    opened = load(scene).to(fastest_device())
    facts = describe(opened, scene, chosen_cameras(opened, cameras, None)[0], console=Console(stderr=True))
    if json:
        print(dumps(without_nan(facts)))
        return 0
    facts["invisible"] = f"{facts['invisible']:.1%} of the Gaussians, to {facts.pop('seen_by')}"
    facts["crop"] = f"--crop {' '.join(f'{side:.15g}' for side in facts['crop'])} holds 99% of what they see"
    for name, value in facts.items():
        attributes = value if isinstance(value, dict) else {}
        line = f"{name.replace('_', ' '):22}{'' if attributes else _words(value)}".rstrip()
        print(line, *(f"  {attribute:20}{size:,}" for attribute, size in attributes.items()), sep="\n")
    return 0


def _words(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(f"{number:.{6 if abs(number) < 1e5 else 10}g}" for number in value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:,}" if isinstance(value, int) else str(value or "-")
