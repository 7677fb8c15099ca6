"""nerfstudio's parsers of captures, with their wrong steps replaced, and the checks of what they make."""

from sundae_ns.parsing.cameras import check_cameras, check_projection, other_frame, stray_tests, warn_of_cloud
from sundae_ns.parsing.dataparsers import CarefulColmapParser, LightNerfstudioParser, check_capture, set_parser
from sundae_ns.parsing.placing import rebound
from sundae_ns.parsing.undistortion import undistorting

__all__ = [
    "CarefulColmapParser",
    "LightNerfstudioParser",
    "check_cameras",
    "check_capture",
    "check_projection",
    "other_frame",
    "rebound",
    "set_parser",
    "stray_tests",
    "undistorting",
    "warn_of_cloud",
]
