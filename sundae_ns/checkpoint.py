"""Checkpoints: what a SUNDAE checkpoint says of itself, and fields read from other sources.

Files are read with plain ``torch.load`` (weights only), never by running what a file asks for.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sundae_ns.errors import CheckpointError
from sundae_ns.gaussians.parameters import SPLAT_NAMES
from sundae_ns.storage.ply import read_ply
from sundae_ns.storage.point_cloud import is_nerfstudio_ply

EXTRA_STATE = "_extra_state"
FORMAT = 1
_PREFIX = "gauss_params."


def extra_state(
    step: int,
    num_features: int,
    strategy: Mapping[str, Any],
    pruning: Mapping[str, Any],
    trained_focal: tuple[float, float] | None,
) -> dict[str, Any]:
    """What a checkpoint carries beside the tensors of the model: plain numbers, strings, and tensors."""
    return {
        "method": "sundae",
        "format": FORMAT,
        "step": step,
        "num_features": num_features,
        "strategy": dict(strategy),
        "pruning": dict(pruning),
        "trained_focal": None if trained_focal is None else list(trained_focal),
    }


def check_model_state(state: Mapping[str, Any], expected: Mapping[str, Tensor], num_features: int) -> None:
    """Check that a model's state fits the model, before anything is changed.

    Args:
        state: state of the checkpoint's model, without the pipeline's prefix.
        expected: ``state_dict`` of the model it is loaded into.
        num_features: feature width of that model; 0 without a head.

    Raises:
        CheckpointError: another method's checkpoint, another format, feature width or head.
    """
    extra = state.get(EXTRA_STATE)
    if not isinstance(extra, Mapping) or extra.get("method") != "sundae":
        kind = "a splatfacto checkpoint" if _PREFIX + "means" in state else "the checkpoint of another method"
        raise CheckpointError(
            f"this is {kind}, not one of sundae; start from it with --pipeline.model.warm-start PATH, not --load-dir"
        )
    if extra["format"] != FORMAT:
        raise CheckpointError(
            f"the checkpoint has format {extra['format']}, this version reads {FORMAT}; use the version that wrote it"
        )
    if extra["num_features"] != num_features:
        raise CheckpointError(
            f"the checkpoint has feature vectors of length {extra['num_features']}, the model of length {num_features}; "
            f"give --pipeline.model.head.num-features {extra['num_features']} (0 means a model without a head)"
        )
    for name, value in expected.items():
        if not isinstance(value, Tensor) or name == EXTRA_STATE:
            continue
        if name not in state:
            raise CheckpointError(f"the checkpoint has no {name}; load it with the options that it was trained with")
        per_primitive = name.startswith(_PREFIX)
        theirs, ours = state[name].shape, value.shape
        if (theirs[1:] != ours[1:]) if per_primitive else (theirs != ours):
            raise CheckpointError(
                f"{name} is {list(theirs)} in the checkpoint and {list(ours)} in the model; "
                "load it with the options that it was trained with"
            )


@contextmanager
def _numpy_numbers_allowed() -> Iterator[None]:
    """Let weights-only loading read the numpy floats that stock nerfstudio leaves in a scheduler's state."""
    scalar = np.float64(0.0).__reduce__()[0]
    allowed: list[Any] = [
        scalar,
        (scalar, "numpy.core.multiarray.scalar"),
        (scalar, "numpy._core.multiarray.scalar"),
        np.dtype,
        type(np.dtype(np.float64)),
        type(np.dtype(np.float32)),
    ]
    with torch.serialization.safe_globals(allowed):
        yield


def read_field(path: Path) -> tuple[dict[str, Tensor], bool]:
    """Read a finished field: a splatfacto or SUNDAE checkpoint (file or folder), or a 3DGS ``.ply``.

    Args:
        path: ``.ckpt`` file, a folder of them (the newest counts), or ``.ply`` file.

    Returns:
        The parameters of ``gaussians.parameters`` without features, float32 on the CPU; and whether they are in the
        coordinates of nerfstudio's model (checkpoints, ``ns-export``) rather than in those of the capture (other ``.ply``).

    Raises:
        CheckpointError: there is no such file, or it holds no Gaussian field.
    """
    path = Path(path)
    if path.is_dir():
        checkpoints = sorted(path.glob("*.ckpt")) or sorted(path.glob("nerfstudio_models/*.ckpt"))
        if not checkpoints:
            raise CheckpointError(f"{path} holds no checkpoint; give a .ckpt file, the folder of them, or a .ply")
        path = checkpoints[-1]
    if not path.is_file():
        raise CheckpointError(f"{path} does not exist; give a .ckpt file, the folder of them, or a .ply")
    if path.suffix == ".ply":
        return {name: value for name, value in read_ply(path).items() if name in SPLAT_NAMES}, is_nerfstudio_ply(path)
    try:
        with _numpy_numbers_allowed():
            loaded = torch.load(path, map_location="cpu")
        state = loaded["pipeline"]
    except Exception as error:  # torch.load raises many kinds; each means the same to the user
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(
            f"{path} cannot be read as a nerfstudio checkpoint ({reason}); give another file"
        ) from error
    prefix = "_model.module." if f"_model.module.{_PREFIX}means" in state else "_model."
    keys = {name: f"{prefix}{_PREFIX}{name}" for name in SPLAT_NAMES}
    if any(key not in state for key in keys.values()):
        raise CheckpointError(f"{path} holds no Gaussian field; give a checkpoint of splatfacto or sundae")
    return {name: state[key].float() for name, key in keys.items()}, True
