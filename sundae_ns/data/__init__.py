"""Captures: checks of their files before a parser reads them, COLMAP models, photos, and the demo's own capture."""

from sundae_ns.data.capture import check_image, check_transforms
from sundae_ns.data.colmap import check_colmap
from sundae_ns.data.demo_capture import write_demo_capture

__all__ = ["check_colmap", "check_image", "check_transforms", "write_demo_capture"]
