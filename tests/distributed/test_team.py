"""The verbs behind which the trainer does not see the number of processes."""

from __future__ import annotations

import copy
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from sundae_ns.distributed import Team
from sundae_ns.distributed.densification import ShardedDensification
from sundae_ns.distributed.pruning import RankPruner
from sundae_ns.errors import ConfigError
from sundae_ns.gaussians.field import Field
from sundae_ns.method_configs import sundae_tiny
from sundae_ns.rendering import LocalField
from sundae_ns.training.dense_start import DenseStart
from sundae_ns.training.densification import CappedStrategy, Densification
from sundae_ns.training.extension import Extension
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.photo_gains import PhotoGains
from sundae_ns.training.pruning import ScheduledPruning
from sundae_ns.training.pruning_config import PruningConfig
from sundae_ns.training.schedules import PruningSchedule


@pytest.fixture
def config() -> Any:
    config: Any = copy.deepcopy(sundae_tiny.config)
    config.machine.device_type, config.vis = "cpu", "viewer+wandb"
    return config


def test_one_process_changes_nothing(config: Any) -> None:
    team = Team()
    assert not team.collective
    assert team.configured(config) is config
    state = FieldState(field=Field({"means": torch.zeros(2, 3)}), networks=torch.nn.ModuleDict())
    source, extensions = LocalField(state.field), [Extension()]
    shared = team.share(state, source, extensions, None, 0)
    assert shared[0] is source
    assert shared[1] is extensions
    made: Any = object()
    assert team.optimizers(lambda: made, None, None, []) is made
    checkpoint = {"step": 3}
    assert team.gathered(checkpoint, None, []) is checkpoint
    assert team.part(checkpoint, []) is checkpoint
    random = torch.get_rng_state()
    team.restored(state, 0, 4)
    assert torch.equal(torch.get_rng_state(), random)


def test_ranks_train_in_larger_batches_without_a_viewer(config: Any) -> None:
    team = Team(0, 2)
    assert team.collective
    found = team.configured(config)
    assert (found.max_num_iterations, found.vis) == (config.max_num_iterations // 2, "wandb")
    assert found.pipeline.datamanager.cache_images == "cpu"
    assert config.vis == "viewer+wandb"
    config.mixed_precision = True
    with pytest.raises(ConfigError, match="several GPUs"):
        team.configured(config)


def test_ranks_densify_and_prune_as_one() -> None:
    team, shards = Team(0, 2), SimpleNamespace(by_first=lambda compute: compute(), summed=lambda values: values)
    team.shards = shards  # type: ignore[assignment]
    strategy = CappedStrategy(refine_every=6)
    densification = team._sharded(Densification(strategy), 7)
    assert isinstance(densification, ShardedDensification)
    assert densification.strategy is strategy
    assert strategy.pause_refine_after_reset == 4 + 6, "each of 7 images is seen in 4 steps of 2"
    pruning = team._sharded(ScheduledPruning(PruningSchedule(PruningConfig(prune_at=3)), evaluate=True), 7)
    assert isinstance(pruning, ScheduledPruning)
    assert (pruning.schedule.config.prune_at, pruning.evaluate) == (3, True)
    pruner = pruning.pruner({}, {}, [])
    assert isinstance(pruner, RankPruner)
    assert pruner.shards is shards
    dense = DenseStart(sundae_tiny.config.pipeline.model, None, 7, num_features=0, cap=None)  # type: ignore[attr-defined]
    assert team._sharded(dense, 7) is dense
    assert dense.found is shards.by_first
    gains = PhotoGains(7, "on")
    assert team._sharded(gains, 7) is gains
    assert gains.total is shards.summed
    other = Extension()
    assert team._sharded(other, 7) is other
