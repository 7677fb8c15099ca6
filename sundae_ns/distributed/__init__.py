"""One field on several ranks: shards, the exchange of primitives, and training as one (``docs/several_gpus.md``)."""

from sundae_ns.distributed.shards import Shards
from sundae_ns.distributed.source import ShardedField
from sundae_ns.distributed.start import check_machine, check_options, forward_signals
from sundae_ns.distributed.team import Team

__all__ = ["ShardedField", "Shards", "Team", "check_machine", "check_options", "forward_signals"]
