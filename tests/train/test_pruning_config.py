"""Steps that follow from the options of pruning."""

from __future__ import annotations

from typing import Any

import pytest

from sundae_ns.train.pruning import PruningConfig


@pytest.mark.parametrize(
    ("options", "first", "last", "settled"),
    [
        ({"prune_at": 7}, 7, 7, 7),
        ({"mode": "off", "prune_at": 7}, None, 7, 7),
        ({"mode": "continuous", "start": 4, "stop": 21, "every": 5}, 4, 19, 21),
        ({"mode": "continuous", "start": 4, "stop": 24, "every": 5}, 4, 24, 24),
        ({"mode": "continuous", "start": 4, "stop": 21, "every": 5, "target_gaussians": 9}, 4, 21, 21),
        ({"mode": "continuous", "start": 4, "stop": 21, "every": 5, "max_gaussians": 9}, 4, 21, 21),
    ],
)
def test_steps_of_the_prunes(options: dict[str, Any], first: int | None, last: int, settled: int) -> None:
    config = PruningConfig(**options)
    assert (config.first_prune, config.last_due, config.settled_at) == (first, last, settled)
