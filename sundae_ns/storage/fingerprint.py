"""The fingerprint of a run's options: rows of equal fingerprints were made by the same method with the same options."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

LEFT_OUT = frozenset(
    # Names, places and seeds.
    "method_name experiment_name project_name timestamp output_dir relative_model_dir data pipeline.datamanager.data "
    "pipeline.datamanager.train_cameras_sampling_seed pipeline.model.pruning.seed "
    # How the capture is read belongs to the capture.
    "pipeline.datamanager.dataparser pipeline.datamanager.robust_frame "
    # The machine, and where it keeps images.
    "machine pipeline.datamanager.cache_images pipeline.datamanager.max_thread_workers "
    "pipeline.datamanager.masks_on_gpu pipeline.datamanager.images_on_gpu "
    # Logs, saves, evaluations, and resuming.
    "logging log_gradients viewer vis start_paused prompt save_only_latest_checkpoint "
    "steps_per_save steps_per_eval_batch steps_per_eval_image steps_per_eval_all_images "
    "load_dir load_step load_config load_checkpoint load_scheduler pipeline.datamanager.eval_image_indices "
    "pipeline.datamanager.eval_num_images_to_sample_from pipeline.datamanager.eval_num_times_to_repeat_images "
    "pipeline.model.evaluate_prune".split()
)
"""Options of a trainer that decide neither quality nor time of what is trained, by their dotted names."""
GONE = {"pipeline.model.pruning": {"search_every": 250, "patience": 4}}
"""Options that have gone, by the configuration that had them. They decided nothing in the runs that have today's
options, so these still count them with the value that all had."""
DECIDED = {"pipeline.model.photo_gains": "auto"}
"""Options that came later, by the value that counts as absent: it decides by the capture, and where it decides against
the option, a run is as before there was one, to the bit."""
LENGTH = 8
_LETTERS = str.maketrans("0123456789abcdef", "abcdefghijklmnop")


def fingerprint(config: Any) -> str:
    """Eight letters that stand for the options which decide a run's results; a table cannot read them as a number.

    Options that are off (None or False) count as absent, so that a new option that is off by default changes nothing.
    Classes count by their bare names, so that a class may move.
    """
    text = json.dumps(_plain(config, ""), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:LENGTH].translate(_LETTERS)


def _plain(value: Any, name: str) -> Any:
    """A value as JSON has it; None for one that is off."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: getattr(value, field.name, None) for field in dataclasses.fields(value)}
        return {"": type(value).__name__, **GONE.get(name, {}), **_entries(fields, name)}
    if isinstance(value, Mapping):
        return _entries(value, name)
    if isinstance(value, (list, tuple)):
        return [_plain(inner, name) for inner in value]
    if isinstance(value, Enum):
        return _plain(value.value, name)
    if isinstance(value, Path):
        return "a path"
    if isinstance(value, float):
        # An option may be written as 1 or as 1.0.
        return int(value) if value.is_integer() else repr(value)
    return value if isinstance(value, (str, int)) and value is not False else None


def _entries(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    """The entries that count, by name."""
    found = {}
    for key, value in values.items():
        inner = f"{name}.{key}".lstrip(".")
        left_out = inner in LEFT_OUT or key == "_target" or DECIDED.get(inner) == value
        plain = None if left_out else _plain(value, inner)
        if plain is not None:
            found[str(key)] = plain
    return found
