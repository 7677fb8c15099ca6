"""One field on several ranks: shards, the exchange of primitives, and training as one (``docs/several_gpus.md``)."""

from sundae_ns.distributed.shards import DRIFT, Shards, bounds, moves
from sundae_ns.distributed.source import ReceivedPrimitives, ShardedField
from sundae_ns.distributed.start import check_machine, check_options, launch
from sundae_ns.distributed.team import OneProcess, Ranks, take_shard, team_of

__all__ = [
    "DRIFT",
    "OneProcess",
    "Ranks",
    "ReceivedPrimitives",
    "ShardedField",
    "Shards",
    "bounds",
    "check_machine",
    "check_options",
    "launch",
    "moves",
    "take_shard",
    "team_of",
]
