"""Files: .ply, .spz, .sog, .glb and packed scenes; runs; atomic writes, sizes in bytes, similarity transforms."""

from sundae_ns.storage.accounting import Sizes, bytes_of, bytes_of_module, megabytes, stored_bytes
from sundae_ns.storage.atomic import replacing, write_text
from sundae_ns.storage.ply import MODEL_FRAME, is_nerfstudio_ply, ply_comments, read_ply, read_point_cloud, write_ply
from sundae_ns.storage.transform import similarity

__all__ = [
    "MODEL_FRAME",
    "Sizes",
    "bytes_of",
    "bytes_of_module",
    "is_nerfstudio_ply",
    "megabytes",
    "ply_comments",
    "read_ply",
    "read_point_cloud",
    "replacing",
    "similarity",
    "stored_bytes",
    "write_ply",
    "write_text",
]
