"""The share of the primitives that the prunes of a run kept."""

from __future__ import annotations

from typing import Any

import pytest

from sundae_ns.scenes.models import _kept, _seconds


@pytest.mark.parametrize(
    ("prunes", "kept"),
    [
        ([{"before": 200, "after": 60}], 0.3),  # one-shot
        ([{"before": 100, "after": 50}, {"before": 80, "after": 40}], 0.25),  # continuous: the field grows in between
        ([], None),
        ([{"before": 100, "after": 50}, {"after": 40}], None),
        ([{"before": 0, "after": 0}], None),
        ([{"before": "many", "after": 1}], None),
    ],
)
def test_the_share_is_the_kept_over_all_prunes(prunes: list[dict[str, Any]], kept: float | None) -> None:
    assert _kept(prunes) == (None if kept is None else pytest.approx(kept))


def test_seconds_are_summed() -> None:
    assert _seconds([{"seconds": 1}, {"seconds": 0.5}]) == 1.5
    assert _seconds([{"seconds": 1}, {}]) is None
    assert _seconds([]) is None
