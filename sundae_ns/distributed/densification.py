"""Densification of a sharded field: each rank densifies its shard, and the ranks are balanced when they drift apart."""

from __future__ import annotations

from sundae_ns.distributed.shards import DRIFT, Shards
from sundae_ns.distributed.source import send_statistics, statistics_of
from sundae_ns.gaussians.parameters import num_primitives
from sundae_ns.training.densification import CappedStrategy, Densification
from sundae_ns.training.field_state import FieldState


class ShardedDensification(Densification):
    """Densification with statistics of all ranks. Collective."""

    def __init__(self, strategy: CappedStrategy, shards: Shards) -> None:
        super().__init__(strategy)
        self.shards = shards

    def before_backward(self, state: FieldState) -> None:
        """Keep the gradients that densification reads, and let its statistics travel back with them."""
        super().before_backward(state)
        if state.densifying:
            send_statistics(state.info, absgrad=self.strategy.absgrad)

    def densify(self, state: FieldState) -> None:
        """Densify every shard, and balance the ranks if the largest shard exceeds the mean by :data:`DRIFT`."""
        shards, running, params = self.shards, state.densification, state.field
        peak, running["peak"] = running["peak"], 0
        self.strategy.step_post_backward(
            params=state.field.data,
            optimizers=state.optimizers,
            state=running,
            step=state.schedule_step,
            info={"statistics": statistics_of(state.info)},
        )
        if state.schedule_step % self.strategy.refine_every == 0:
            shards.changed()  # the only steps at which primitives appear and disappear
            numbers = shards.numbers(num_primitives(params), max(running["peak"], num_primitives(params)))
            shards.counts = [count for count, _ in numbers]
            peak = max(peak, sum(most for _, most in numbers))
            if max(shards.counts) > DRIFT * shards.total / shards.ranks:
                shards.level(params, state.optimizers, [running])
        running["peak"] = peak
