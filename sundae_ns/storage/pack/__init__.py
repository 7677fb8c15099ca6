"""Packed scenes: a field, its head and its cameras in one small, checksummed file without executable content."""

from sundae_ns.storage.pack.codecs import Codecs, Sensitivity
from sundae_ns.storage.pack.config import FINETUNE_STEPS, FINETUNED, FINETUNED_SIZE, PackConfig, tuned_steps
from sundae_ns.storage.pack.container import read_header
from sundae_ns.storage.pack.scene import (
    PackedScene,
    PackReport,
    fit_scene,
    pack_bytes,
    read_scene,
    write_fitted,
    write_scene,
)

__all__ = [
    "FINETUNE_STEPS",
    "FINETUNED",
    "FINETUNED_SIZE",
    "Codecs",
    "PackConfig",
    "PackReport",
    "PackedScene",
    "Sensitivity",
    "fit_scene",
    "pack_bytes",
    "read_header",
    "read_scene",
    "tuned_steps",
    "write_fitted",
    "write_scene",
]
