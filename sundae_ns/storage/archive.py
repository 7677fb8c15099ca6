"""Files of ``torch.save`` from others: checked before they are read, and read weights-only, so that no code runs."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from sundae_ns.errors import one_line


def damage_of(file: BinaryIO) -> str | None:
    """Why a file is no whole archive of tensors; None if its checksums, which torch does not verify, are right."""
    try:
        with zipfile.ZipFile(file) as archive:
            entries = archive.infolist()
            packed = any(entry.compress_type != zipfile.ZIP_STORED for entry in entries)
            if packed or sum(entry.file_size for entry in entries) > os.fstat(file.fileno()).st_size:
                return "it would unpack to more than its size"
            broken = archive.testzip()
            return None if broken is None else f"{broken} in it is damaged"
    except (OSError, zipfile.BadZipFile, NotImplementedError, RuntimeError, ValueError, OverflowError) as error:
        return getattr(error, "strerror", None) or one_line(error)


def load_tensors(file: BinaryIO) -> Any:
    """The tensors and plain values of an open archive without :func:`damage_of`, on the CPU.

    Raises:
        Exception: of many kinds, which all mean that it holds something else.
    """
    file.seek(0)
    with _numpy_numbers_allowed():
        loaded = torch.load(file, map_location="cpu", weights_only=True)
    _check_tensors(loaded)
    return loaded


def _check_tensors(value: Any) -> None:
    """Refuse sparse or quantized tensors, and tensors larger than their storage, whose copy would fill memory."""
    if isinstance(value, Tensor):
        if value.layout is not torch.strided or value.is_quantized or value.is_meta:
            raise ValueError("it holds a tensor that is sparse, quantized or without values")
        if value.numel() * value.element_size() > value.untyped_storage().nbytes():
            raise ValueError("it holds a tensor that claims more than it has")
    elif isinstance(value, (Mapping, list, tuple)):
        for inner in value.values() if isinstance(value, Mapping) else value:
            _check_tensors(inner)


def _numpy_numbers_allowed() -> Any:
    """A context in which torch reads the numpy floats that stock nerfstudio leaves in a scheduler's state."""
    scalar: Any = np.float64(0.0).__reduce__()[0]
    names = [(scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    types: list[Any] = [np.dtype, type(np.dtype(np.float64)), type(np.dtype(np.float32))]
    return torch.serialization.safe_globals([scalar, *names, *types])
