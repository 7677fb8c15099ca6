"""Checkpoints: whole files, the state beside the tensors, the checks before loading, and states of random generators.

A checkpoint is a zip archive of ``torch.save``, as nerfstudio writes it:

    data.pkl   {"step", "pipeline", "optimizers", "schedulers", "scalers", "random"}
    data/N     bytes of tensor N, stored, not deflated

``pipeline`` has the tensors by ``_model.gauss_params.NAME`` and ``_model.networks.head.NAME``, and
``_model._extra_state``, see :func:`check_extra_state`. No code of files runs; their checksums are verified first.
"""

from __future__ import annotations

import os
import pickletools
import random
import re
import zipfile
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from encodings import normalize_encoding
from encodings.aliases import aliases
from numbers import Integral
from pathlib import Path
from typing import Any, BinaryIO, get_args

import numpy as np
import torch
from torch import Tensor

from sundae_ns.core.errors import CheckpointError, StorageError, one_line, reading, regular
from sundae_ns.core.files import replacing
from sundae_ns.core.gaussians import SPLAT_NAMES, Encoding, Gaussians, odd_shapes

EXTRA_STATE = "_extra_state"
_NO_CLOCK = "the checkpoint does not say where training stopped; give another"
FORMAT = 2
OURS = {"method": "sundae", "format": FORMAT}
_PREFIX = "gauss_params."
_NAME = re.compile(r"step-(\d+)\.ckpt")
# What pickles of tensors name; torch's own list has makers of gigabytes from a number, such as bytearray.
_MADE = re.compile(
    r"torch (?!\w*Tensor$)\w+|torch\._utils _rebuild_(tensor_v2|parameter)|collections OrderedDict"
    r"|numpy dtype|numpy\._?core\.multiarray scalar|_codecs encode"
)
_CODECS = {"hex_codec", "base64_codec", "quopri_codec", "uu_codec", "punycode", "idna"}  # that grow, or take long
_PARTIAL = "partial--1.{}.tmp"  # unfinished; nerfstudio, which parses a step from every name, reads -1


def checkpoints(folder: Path) -> list[Path]:
    """Checkpoints of a folder by step, the newest last; other file names are ignored."""
    steps = {path: int(match[1]) for path in folder.glob("*.ckpt") if (match := _NAME.fullmatch(path.name))}
    return sorted(steps, key=steps.__getitem__)


def folder_of(run: Path) -> Path:
    """The folder of a run's checkpoints, given that folder or the run's."""
    below = run / "nerfstudio_models"
    return below if below.is_dir() and not any(run.glob("*.ckpt")) else run


def newest_step(path: Path) -> int | None:
    """Step of a checkpoint by its name, or of the newest whole one of a run or its folder; None if there is none."""
    if not path.is_file():
        with suppress(CheckpointError):
            path, _ = newest_whole(path)
    return int(match[1]) if path.is_file() and (match := _NAME.fullmatch(path.name)) else None


def write(state: Mapping[str, Any], path: Path) -> None:
    """Write a checkpoint atomically; a ``StorageError`` names the newest older checkpoint that is whole."""
    try:
        # Through a Python file, because torch's own writer hides the reason of a failed write.
        with replacing(path, path.with_name(_PARTIAL.format(os.getpid()))) as partial, partial.open("wb") as file:
            torch.save(_compact(dict(state)), file)
    except OSError as error:
        step = newest_step(path.parent)
        kept = "no older checkpoint" if step is None else f"the one of step {step} is whole, resume it with --load-dir"
        reason = str(error) if isinstance(error, StorageError) else f"cannot write {path}: {error.strerror or error}"
        raise StorageError(f"{reason} ({kept})") from error


def _compact(value: Any) -> Any:
    """Clone tensors that are a part of a larger memory, which torch would save with them."""
    if isinstance(value, Tensor):
        is_part = value.untyped_storage().nbytes() > value.numel() * value.element_size()
        return value.detach().cpu().clone() if is_part else value
    if isinstance(value, dict):
        return {key: _compact(inner) for key, inner in value.items()}
    return [_compact(inner) for inner in value] if isinstance(value, list) else value


def read(path: Path) -> dict[str, Any]:
    """A checkpoint of nerfstudio's trainer, on the CPU. No code in it runs; ``CheckpointError`` if it is bad."""
    with reading(path, "a checkpoint", CheckpointError, remedy="give another file"), regular(path).open("rb") as file:
        check_whole(file)
        return _loaded(file)


def _loaded(file: BinaryIO) -> dict[str, Any]:
    loaded = load_tensors(file)
    state = loaded.get("pipeline") if isinstance(loaded, dict) else None
    if not isinstance(state, Mapping) or not all(isinstance(name, str) for name in state):
        raise ValueError("it holds no model")
    if not isinstance(loaded.get("step"), Integral):
        raise ValueError("it does not say after which step it was saved")
    return loaded  # type: ignore[no-any-return]


def newest_whole(folder: Path) -> tuple[Path, list[str]]:
    """The newest whole checkpoint of a folder or a run, and a line for each newer damaged one; ``CheckpointError``."""
    path, file, skipped = _open_newest(folder)
    file.close()
    return path, skipped


def read_newest(folder: Path) -> tuple[Path, dict[str, Any]]:
    """The newest whole checkpoint of a folder or a run, and its contents, also while a training replaces it."""
    path, file, _ = _open_newest(folder)
    with file, reading(path, "a checkpoint", CheckpointError, remedy="give another file"):
        return path, _loaded(file)


def _open_newest(folder: Path) -> tuple[Path, BinaryIO, list[str]]:
    """As :func:`newest_whole`, with the open file, which stays readable after a training has removed it."""
    skipped: list[str] = []
    before: list[Path] | None = None
    while (listed := checkpoints(folder_of(folder))) != before:  # else a training has replaced them meanwhile
        skipped.clear()
        for path in reversed(listed):
            with ExitStack() as stack:
                try:
                    file = stack.enter_context(regular(path).open("rb"))
                    check_whole(file)
                except (OSError, ValueError) as error:
                    skipped.append(f"{path.name} is not whole ({getattr(error, 'strerror', None) or one_line(error)})")
                else:
                    stack.pop_all()
                    return path, file, skipped
        before = listed
    reasons = f" ({'; '.join(skipped)})" if skipped else ""
    raise CheckpointError(f"{folder} holds no whole checkpoint{reasons}; give the folder of a run that saved one")


def check_extra_state(state: Mapping[str, Any], num_features: int, encoding: Encoding) -> Mapping[str, Any]:
    """The state beside the tensors in a model's ``state``, checked against the model's features and encoding.

    It has :data:`OURS`; ``step``; ``num_features`` as configured, 0 without a head; ``encoding`` of colours;
    ``running`` with the states of ``densification`` and ``pruning``; ``extensions`` with those of the callbacks, by
    name; ``trained_focal``, the shortest and longest focal length of the head's training, pixels; ``head_enabled``.
    """
    extra = state.get(EXTRA_STATE)
    if not isinstance(extra, Mapping) or extra.get("method") != "sundae":
        kind = "a splatfacto checkpoint" if _PREFIX + "means" in state else "the checkpoint of another method"
        raise CheckpointError(f"this is {kind}; start from it with --pipeline.model.warm-start PATH, not --load-dir")
    _check_format(extra)
    for name, ours, hint in (
        ("num_features", num_features, "head.num-features that it was trained with (0 means a model without a head)"),
        ("encoding", encoding, "sh-degree that it was trained with (0 stores logits)"),
    ):
        if extra.get(name) != ours:
            stated = f"the checkpoint has {name} {extra.get(name)}, the model {ours}"
            raise CheckpointError(f"{stated}; give the --pipeline.model.{hint}")
    states = (extra.get("running"), extra.get("extensions"))
    if not all(isinstance(state, Mapping) for state in states) or "trained_focal" not in extra:
        raise CheckpointError(_NO_CLOCK)
    return extra


def _check_format(extra: Mapping[str, Any]) -> None:
    if extra.get("format") != FORMAT:
        stated = f"the checkpoint has format {extra.get('format')}, this version reads {FORMAT}"
        raise CheckpointError(f"{stated}; use the version that wrote it")


def check_model_state(state: Mapping[str, Any], expected: Mapping[str, Tensor]) -> None:
    """Raise ``CheckpointError`` unless a state, whose extra state was checked, fits the ``state_dict`` of a model."""
    remedy = "load it with the options that it was trained with"
    for name, value in expected.items():
        if not isinstance(value, Tensor) or name == EXTRA_STATE:
            continue
        if not isinstance(state.get(name), Tensor):
            raise CheckpointError(f"the checkpoint has no {name}; {remedy}")
        theirs, ours = state[name].shape, value.shape
        rows = 1 if name.startswith(_PREFIX) else 0  # another number of Gaussians fits
        if len(theirs) < rows or theirs[rows:] != ours[rows:]:
            hint = ", such as its --pipeline.model.head.size" if name.startswith("networks.head.") else ""
            raise CheckpointError(f"{name} is {list(theirs)} in the file, {list(ours)} in the model; {remedy}{hint}")
    counts = sorted({state[name].shape[0] for name in expected if name.startswith(_PREFIX)})
    if len(counts) != 1 or counts[0] == 0:
        raise CheckpointError(f"the checkpoint has parameters of {counts} Gaussians; give another")
    pruning, densification = (state[EXTRA_STATE]["running"].get(name) for name in ("pruning", "densification"))
    numbers = [state[EXTRA_STATE].get("step"), *(pruning.values() if isinstance(pruning, Mapping) else [None])]
    if not all(isinstance(value, int) for value in numbers) or not isinstance(densification, Mapping):
        raise CheckpointError(_NO_CLOCK)
    for name, value in densification.items():
        if isinstance(value, Tensor) and value.ndim > 0 and len(value) != counts[0]:
            raise CheckpointError(f"{name} has {len(value)} rows, the checkpoint {counts[0]} Gaussians; give another")


def gaussians_of(loaded: Mapping[str, Any], path: Path) -> Gaussians:
    """Gaussians of a checkpoint from :func:`read`, without features, float32 on the CPU; ``CheckpointError`` if none.

    Splatfacto, which does not say how it stores colours, stores logits at SH degree 0.
    """
    state = model_state(loaded)
    extra = state.get(EXTRA_STATE)
    stored = {name: state.get(_PREFIX + name) for name in SPLAT_NAMES}
    gaussians = {name: value.float() for name, value in stored.items() if isinstance(value, Tensor)}
    if len(gaussians) < len(stored):
        raise CheckpointError(f"{path} holds no Gaussians; give a checkpoint of splatfacto or sundae")
    for odd in odd_shapes(gaussians):
        raise CheckpointError(f"{path} has a parameter of an odd shape ({odd}); give another file")
    if not isinstance(extra, Mapping) or extra.get("method") != "sundae":
        return Gaussians(gaussians, "harmonics" if gaussians["features_rest"].shape[1] else "logits")
    _check_format(extra)
    if extra.get("encoding") not in get_args(Encoding):
        raise CheckpointError("the checkpoint does not say how it stores colours; give another")
    return Gaussians(gaussians, extra["encoding"])


def model_state(loaded: Mapping[str, Any]) -> dict[str, Any]:
    """State of the model in a checkpoint, by its own names."""
    state = {name: value for name, value in loaded["pipeline"].items() if name.startswith("_model.")}
    return {name.removeprefix("_model.").removeprefix("module."): value for name, value in state.items()}


def check_whole(file: BinaryIO) -> None:
    """Raise ``ValueError`` unless a file is a whole archive of tensors, by checksums, which torch does not verify."""
    try:
        with zipfile.ZipFile(file) as archive:
            entries = archive.infolist()
            packed = any(entry.compress_type != zipfile.ZIP_STORED for entry in entries)
            if packed or sum(entry.file_size for entry in entries) > os.fstat(file.fileno()).st_size:
                raise ValueError("it would unpack to more than its size")
            if (damaged := archive.testzip()) is not None:
                raise ValueError(f"{damaged} in it is damaged")
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, OverflowError) as error:
        raise ValueError(one_line(error)) from error


def load_tensors(file: BinaryIO) -> Any:
    """The tensors and plain values of an open, whole archive, on the CPU; raises many kinds of errors for others."""
    with zipfile.ZipFile(file) as archive:
        for name in archive.namelist():
            if name.endswith(".pkl"):
                _check_pickle(archive.read(name))
    file.seek(0)
    # Stock nerfstudio leaves numpy floats in a scheduler's state.
    names = [(_scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    types: list[Any] = [np.dtype, type(np.dtype(np.float64)), type(np.dtype(np.float32))]
    with torch.serialization.safe_globals([*names, *types]):
        loaded = torch.load(file, map_location="cpu", weights_only=True)
    _check_tensors(loaded)
    return loaded


def _check_pickle(pickled: bytes) -> None:
    if len(pickled) > 1 << 21:  # a second's work; real ones are much smaller, as tensors lie beside them
        raise ValueError(f"its structure has {len(pickled):,} bytes")
    ranks: dict[Any, int] = {}  # nesting depth of each tuple, by its index in the pickle's memo
    rank = 0
    is_tuple = False
    for operation, argument, _ in pickletools.genops(pickled):
        rank = max(rank, ranks.get(argument, 0)) if "GET" in operation.name else rank
        if is_tuple and "PUT" in operation.name:
            ranks[argument] = rank + 1
        is_tuple = "TUPLE" in operation.name
        if rank > 20:  # the hash of a tuple visits each as often as it is held
            raise ValueError("it holds tuples in tuples without end")
        if operation.name == "GLOBAL" and not _MADE.fullmatch(str(argument)):
            raise ValueError(f"it holds more than tensors and plain values ({argument})")
        if isinstance(argument, str):
            name = normalize_encoding(argument).lower()
            if aliases.get(name, name) in _CODECS:
                raise ValueError(f"it asks for the codec {argument}")


def _scalar(dtype: np.dtype[Any], content: bytes) -> Any:
    """A number of numpy, whose own function also makes one of any size from no bytes."""
    return np.frombuffer(content, dtype, 1)[0]


def _check_tensors(loaded: Any) -> None:
    """Refuse tensors larger than their storage, whose copy would fill memory."""
    visited = set[int]()
    waiting = [loaded]
    while waiting:
        value = waiting.pop()
        if isinstance(value, Tensor) and value.numel() * value.element_size() > value.untyped_storage().nbytes():
            raise ValueError("it holds a tensor that claims more than it has")
        if isinstance(value, (Mapping, list, tuple)) and id(value) not in visited:  # lists may hold themselves
            visited.add(id(value))
            waiting += value.values() if isinstance(value, Mapping) else value


def random_state() -> dict[str, Any]:
    """State of all random generators that training uses, as plain numbers and tensors."""
    kind, keys, position, has_gauss, gauss = np.random.get_state()
    plain = str(kind), [int(key) for key in keys], int(position), int(has_gauss), float(gauss)
    cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    return {"python": random.getstate(), "numpy": plain, "torch": torch.get_rng_state(), "cuda": cuda}


def set_random_state(state: Mapping[str, Any]) -> None:
    """Counterpart of :func:`random_state`; CUDA generators are left alone if the number of devices differs."""
    random.setstate(state["python"])
    kind, keys, position, has_gauss, gauss = state["numpy"]
    np.random.set_state((kind, np.array(keys, dtype=np.uint32), position, has_gauss, gauss))
    torch.set_rng_state(state["torch"])
    if len(state["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(list(state["cuda"]))
