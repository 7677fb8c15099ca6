"""Captures: checks before they are parsed, and the embedded capture for the demo and the tests. Floor 1.

``capture`` and ``colmap`` check files of other programs. :func:`write_embedded_capture` ray-traces a still life and writes
it as a nerfstudio data set. Its parts are ``shapes`` and ``textures`` (solids), ``still_life`` (the scene), ``cameras``,
``tracer`` (images) and ``points`` (a sparse point cloud). ``camera_axes`` converts camera poses.
"""

from sundae_ns.data.capture import check_image, check_transforms
from sundae_ns.data.colmap import check_colmap
from sundae_ns.data.scene_folder import write_embedded_capture

__all__ = ["check_colmap", "check_image", "check_transforms", "write_embedded_capture"]
