"""What trials of counts remember, and how large they expect a packed scene to be."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.gaussians import FEATURES
from sundae_ns.storage.pack.scene import PackedScene, fit_scene, pack_bytes
from sundae_ns.training.pruning_config import PruningConfig
from sundae_ns.training.trials.count import CountTrialProgress, CountTrials, packed_size
from sundae_ns.training.trials.engine import TrialEngine

N = 20_000


@pytest.fixture(scope="module")
def field() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (1,), "features_dc": (3,)}
    shapes |= {"features_rest": (3, 3), FEATURES: (5,)}
    return {name: torch.randn(N, *shape, generator=generator) for name, shape in shapes.items()}


@pytest.mark.parametrize("with_head", [False, True])
def test_a_part_of_a_field_tells_the_size_of_the_whole(field: dict[str, torch.Tensor], with_head: bool) -> None:
    head = CompensationHead(HeadConfig(mode="residual", size="tiny", num_features=5)) if with_head else None
    found = packed_size(field, head)
    assert found is not None
    whole = {name: value for name, value in field.items() if with_head or name != FEATURES}
    data, sections = pack_bytes(*fit_scene(PackedScene(whole, {} if head is None else dict(head.state_dict()))))
    own = sum(size for name, size in sections.items() if name.startswith("head/"))
    assert found.head == pytest.approx(own, rel=0.01)
    assert (found.head > 0) == with_head
    assert found.field == pytest.approx(len(data) - own, rel=0.1)


def test_a_field_that_cannot_be_packed_has_no_size(field: dict[str, torch.Tensor]) -> None:
    assert packed_size({**field, "means": torch.full((N, 3), torch.nan)}) is None


def test_states_of_earlier_versions_keep_their_curve() -> None:
    """They measured each trial twice, and began the list of a trial before its end."""
    view = [[[100.0, 30.0, 0.9, 30.0]], [[100.0, 31.0, 0.9, 31.0]]]
    numbers: dict[str, Any] = {"phase": "done", "full": 100, "counts": [100, 40], "sizes": [9, 5], "chosen": 40}
    trials = CountTrials(PruningConfig(keep_ratio=None), None, TrialEngine(), alone=False)  # type: ignore[arg-type]
    trials.load_state_dict(None, {"numbers": {**numbers, "measured": [view, view, []]}})  # type: ignore[arg-type]
    expected = CountTrialProgress(**numbers, measured=[view[-1], view[-1]])
    assert trials.progress == expected
    assert [point.count for point in trials.progress.curve()] == [100, 40]
