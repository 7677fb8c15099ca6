"""Camera poses of photos and videos by pycolmap: images, features, pairs, reconstruction, capture."""

from sundae_ns.poses.capture_files import Placed, placed_in
from sundae_ns.poses.reconstruct import Found, Matching, Request, find_poses

__all__ = ["Found", "Matching", "Placed", "Request", "find_poses", "placed_in"]
