"""Captures: checked before they are parsed, and the embedded scene for the demo and the tests. Floor 2.

``capture`` and ``colmap`` check what others wrote. The embedded scene is a still life, ray-traced in numpy;
:func:`write_scene` writes it, or a plain wall, as a nerfstudio data set. Its parts are usable alone: ``shapes`` and
``textures`` make the solids, ``still_life`` and ``wall`` place them, ``cameras`` looks at them, ``tracer`` renders,
``points`` imitates structure from motion.
"""

from sundae_ns.data.cameras import Camera, facing, in_frame, look_at, orbit, pixel_rays, project
from sundae_ns.data.capture import check_picture, check_transforms
from sundae_ns.data.colmap import check_colmap
from sundae_ns.data.points import observe, sparse_points
from sundae_ns.data.scene_folder import Kind, held_out_indices, write_scene
from sundae_ns.data.still_life import still_life
from sundae_ns.data.tracer import Body, Scene, first_hits, render, shade
from sundae_ns.data.wall import wall

__all__ = [
    "Body",
    "Camera",
    "Kind",
    "Scene",
    "check_colmap",
    "check_picture",
    "check_transforms",
    "facing",
    "first_hits",
    "held_out_indices",
    "in_frame",
    "look_at",
    "observe",
    "orbit",
    "pixel_rays",
    "project",
    "render",
    "shade",
    "sparse_points",
    "still_life",
    "wall",
    "write_scene",
]
