"""Captures: checks before they are parsed, and the embedded capture for the demo and the tests. Floor 1.

``capture`` and ``colmap`` check files of other programs. :func:`write_embedded_capture` ray-traces a still life, or a
plain wall, and writes it as a nerfstudio data set. Its parts are ``shapes`` and ``textures`` (solids), ``still_life``
and ``wall`` (scenes), ``cameras``, ``tracer`` (images) and ``points`` (a sparse point cloud). ``camera_axes`` converts
camera poses.
"""

from sundae_ns.data.cameras import Camera, facing, in_frame, look_at, orbit, pixel_rays, project
from sundae_ns.data.capture import check_image, check_transforms
from sundae_ns.data.colmap import check_colmap
from sundae_ns.data.points import observe, sparse_points
from sundae_ns.data.scene_folder import Kind, held_out_indices, write_embedded_capture
from sundae_ns.data.still_life import still_life
from sundae_ns.data.tracer import Body, TracedScene, first_hits, render, shade
from sundae_ns.data.wall import wall

__all__ = [
    "Body",
    "Camera",
    "Kind",
    "TracedScene",
    "check_colmap",
    "check_image",
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
    "write_embedded_capture",
]
