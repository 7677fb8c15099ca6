"""One field over several ranks: who holds which primitives, and how the ranks act as one.

The design is in ``docs/distributed.md``.
"""

from sundae_ns.distributed.ahead import Ahead, Look, Timetable, longest_step, slack_of_step
from sundae_ns.distributed.batches import SharedOptimizers, average_gradients, scale_rates, shorten
from sundae_ns.distributed.checkpoints import state_of_rank, whole_state
from sundae_ns.distributed.pruning import GlobalPruning
from sundae_ns.distributed.shards import DRIFT, Arrived, Course, Shards, bounds, moves
from sundae_ns.distributed.start import check_machine, check_options, launch, take_shard, without_viewer

__all__ = [
    "DRIFT",
    "Ahead",
    "Arrived",
    "Course",
    "GlobalPruning",
    "Look",
    "SharedOptimizers",
    "Shards",
    "Timetable",
    "average_gradients",
    "bounds",
    "check_machine",
    "check_options",
    "launch",
    "longest_step",
    "moves",
    "scale_rates",
    "shorten",
    "slack_of_step",
    "state_of_rank",
    "take_shard",
    "whole_state",
    "without_viewer",
]
