"""SUNDAE: Gaussian scenes made small, by a merge along a graph and by what cameras see, with a neural head.

A nerfstudio plug-in, and a library that needs no nerfstudio:

    import sundae_ns as sn

    scene = sn.load("garden.ply")                          # .ply, .spz, .sog, .glb, .sundae, or a run of ns-train
    cameras = sn.virtual_cameras(scene)                    # or sn.cameras_of("transforms.json")
    small = sn.prune(scene, keep=0.1, cameras=cameras)     # a new scene; dropped Gaussians are merged into kept ones
    image = sn.render(small, cameras[0]).rgb               # [H, W, 3], on a CPU or a GPU
    sn.save(small, "small.sundae")

Names are imported on first use, so that ``ns-*`` commands, which load every plug-in, do not wait for this one.
"""

from __future__ import annotations

import gc
import importlib
import sys
from types import FunctionType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sundae_ns.core.camera import Camera as Camera
    from sundae_ns.core.errors import SundaeError as SundaeError
    from sundae_ns.core.metrics import Quality as Quality
    from sundae_ns.plugin.distill import distill as distill
    from sundae_ns.pruning.rule import PruneRule as PruneRule
    from sundae_ns.scene.cameras import cameras_of as cameras_of
    from sundae_ns.scene.load_save import load as load
    from sundae_ns.scene.load_save import save as save
    from sundae_ns.scene.page import show as show
    from sundae_ns.scene.prune_scene import crop as crop
    from sundae_ns.scene.prune_scene import prune as prune
    from sundae_ns.scene.prune_scene import remove_floaters as remove_floaters
    from sundae_ns.scene.scene import Rendering as Rendering
    from sundae_ns.scene.scene import Scene as Scene
    from sundae_ns.scene.scene import measure as measure
    from sundae_ns.scene.scene import render as render
    from sundae_ns.scene.virtual_cameras import virtual_cameras as virtual_cameras

__version__ = "0.2.0"

_HOMES = {
    "Camera": "sundae_ns.core.camera",
    "PruneRule": "sundae_ns.pruning.rule",
    "Quality": "sundae_ns.core.metrics",
    "Rendering": "sundae_ns.scene.scene",
    "Scene": "sundae_ns.scene.scene",
    "SundaeError": "sundae_ns.core.errors",
    "cameras_of": "sundae_ns.scene.cameras",
    "crop": "sundae_ns.scene.prune_scene",
    "distill": "sundae_ns.plugin.distill",
    "load": "sundae_ns.scene.load_save",
    "measure": "sundae_ns.scene.scene",
    "prune": "sundae_ns.scene.prune_scene",
    "remove_floaters": "sundae_ns.scene.prune_scene",
    "render": "sundae_ns.scene.scene",
    "save": "sundae_ns.scene.load_save",
    "show": "sundae_ns.scene.page",
    "virtual_cameras": "sundae_ns.scene.virtual_cameras",
}
"""Public names and the modules that hold them."""

__all__ = [*_HOMES]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # The objects that the first import of torch leaves live as long as the process: do not look for garbage there.
    first = "torch" not in sys.modules and gc.isenabled()
    if first:
        gc.disable()
    try:
        usual_defaults = importlib.import_module("sundae_ns.core.values").usual_defaults
        with usual_defaults():
            value = getattr(importlib.import_module(_HOMES[name]), name)
    finally:
        if first:
            gc.freeze()
            gc.enable()
    globals()[name] = value = usual_defaults()(value) if isinstance(value, FunctionType) else value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
