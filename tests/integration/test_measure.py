"""Figures of a finished run, taken from the run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sundae_ns.errors import CheckpointError
from sundae_ns.measure import frame_times, load_run, sizes


def test_figures_of_a_run(tiny: Any) -> None:
    model, cameras, truths = load_run(tiny.config)
    assert [truth.shape[:2] for truth in truths] == [(int(c.height), int(c.width)) for c in cameras]
    assert all(0 <= truth.min() <= truth.max() <= 1 for truth in truths)
    times = frame_times(model, cameras[:1], warmup=0, repeats=1)
    assert min(times.frame, times.splat, times.head) > 0
    floats = sum(value.numel() for value in model.gauss_params.values())
    assert sizes(model).primitives == 4 * floats
    assert sizes(model).head == sum(p.numel() * p.element_size() for p in model.head.parameters())
    # Before the head's start there is no head to time.
    model.config.head.start_at = 10**9
    assert frame_times(model, cameras[:1], warmup=0, repeats=1).head == 0


def test_a_run_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="does not exist"):
        load_run(tmp_path / "config.yml")
