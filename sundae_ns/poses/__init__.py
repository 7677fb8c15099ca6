"""Camera poses of photos and videos by pycolmap: images, features, pairs, reconstruction, capture."""

from sundae_ns.poses.capture import Placed, placed_in
from sundae_ns.poses.pairs import Matching
from sundae_ns.poses.stages import Found, Request, find_poses

__all__ = ["Found", "Matching", "Placed", "Request", "find_poses", "placed_in"]
