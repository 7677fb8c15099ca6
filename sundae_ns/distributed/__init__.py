"""One field over several ranks: who holds which primitives, and how the ranks act as one.

The design is in ``docs/distributed.md``.
"""

from sundae_ns.distributed.batches import SharedOptimizers, average_gradients, scale_rates, shorten
from sundae_ns.distributed.checkpoints import state_of_rank, whole_state
from sundae_ns.distributed.pruning import GlobalPruning
from sundae_ns.distributed.shards import DRIFT, Arrived, Shards, bounds, moves
from sundae_ns.distributed.start import check_machine, check_options, launch, take_shard, without_viewer

__all__ = [
    "DRIFT",
    "Arrived",
    "GlobalPruning",
    "SharedOptimizers",
    "Shards",
    "average_gradients",
    "bounds",
    "check_machine",
    "check_options",
    "launch",
    "moves",
    "scale_rates",
    "shorten",
    "state_of_rank",
    "take_shard",
    "whole_state",
    "without_viewer",
]
