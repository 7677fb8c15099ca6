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
    from sundae_ns.core.camera import Camera
    from sundae_ns.core.errors import SundaeError
    from sundae_ns.core.metrics import Quality
    from sundae_ns.plugin.distill import distill
    from sundae_ns.pruning.rule import PruneRule
    from sundae_ns.scene.cameras import cameras_of
    from sundae_ns.scene.compose import crop, merge, remove_floaters, transform
    from sundae_ns.scene.load_save import load, save
    from sundae_ns.scene.page import page, show
    from sundae_ns.scene.prune_scene import prune
    from sundae_ns.scene.scene import Rendering, Scene, measure, render
    from sundae_ns.scene.virtual_cameras import virtual_cameras

__version__ = "0.2.0"

_MODULES = {
    "core.camera": "Camera",
    "core.errors": "SundaeError",
    "core.metrics": "Quality",
    "plugin.distill": "distill",
    "pruning.rule": "PruneRule",
    "scene.cameras": "cameras_of",
    "scene.compose": "crop merge remove_floaters transform",
    "scene.load_save": "load save",
    "scene.page": "page show",
    "scene.prune_scene": "prune",
    "scene.scene": "Rendering Scene measure render",
    "scene.virtual_cameras": "virtual_cameras",
}
_HOMES = {name: f"sundae_ns.{module}" for module, names in _MODULES.items() for name in names.split()}
"""Public names and the modules that hold them."""

__all__ = ["Camera", "PruneRule", "Quality", "Rendering", "Scene", "SundaeError", "cameras_of", "crop", "distill"]
__all__ += ["load", "measure", "merge", "page", "prune", "remove_floaters", "render", "save", "show", "transform"]
__all__ += ["virtual_cameras"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # The objects that the first import of torch leaves live as long as the process: do not look for garbage there.
    first = "torch" not in sys.modules and gc.isenabled()
    if first:
        gc.disable()
    try:
        values = importlib.import_module("sundae_ns.core.values")
        with values.usual_defaults():
            value = getattr(importlib.import_module(_HOMES[name]), name)
    finally:
        if first:
            gc.freeze()
            gc.enable()
    globals()[name] = value = values.fitting()(value) if isinstance(value, FunctionType) else value
    return value


def __dir__() -> list[str]:
    return ["__doc__", "__version__", *__all__]
