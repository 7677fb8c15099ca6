"""The processes that train together, one or several, behind one set of verbs that the trainer calls."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
import torch.distributed as dist
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sundae_ns.compensation import CompensationHead
from sundae_ns.distributed.ahead import Timetable
from sundae_ns.distributed.batches import SharedOptimizers, scale_rates, shorten
from sundae_ns.distributed.checkpoints import state_of_rank, whole_state
from sundae_ns.distributed.densification import ShardedDensification
from sundae_ns.distributed.pruning import RankPruner
from sundae_ns.distributed.shards import Shards, bounds
from sundae_ns.distributed.source import ShardedField
from sundae_ns.distributed.start import check_options, without_viewer
from sundae_ns.rendering.source import FieldSource
from sundae_ns.training.dense_start import DenseStart, put
from sundae_ns.training.densification import CappedStrategy, Densification
from sundae_ns.training.extension import Extension
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.floaters import FloaterRemoval
from sundae_ns.training.photo_gains import PhotoGains
from sundae_ns.training.pruning import ScheduledPruning
from sundae_ns.training.warning import warn

State = dict[str, Any]

AGREED_EVERY = 16
"""Steps after which ranks ask each other whether to stop, which waits for the GPU."""


class Team:
    """The ranks of the default process group, which shard the field. With several, verbs are collective.

    One process holds the whole field: its verbs return what they are given.
    """

    shards: Shards
    """Set by :meth:`share` of several ranks."""

    def __init__(self, rank: int = 0, count: int = 1) -> None:
        self.rank, self.count = rank, count
        self.collective = count > 1
        """Whether there are several processes."""

    def agreed(self, number: int, step: int) -> int:
        """The signal after which all processes stop with this step; 0 for none.

        Args:
            number: the signal that this process got; 0 for none.
            step: ranks agree at every :data:`AGREED_EVERY`-th step.
        """
        if not self.collective:
            return number
        if step % AGREED_EVERY:
            return 0
        return min((got for (got,) in self.shards.numbers(number) if got), default=0)

    def meet(self) -> None:
        """Wait for all ranks."""
        if self.collective:
            dist.barrier()

    def configured(self, config: Any) -> Any:
        """A copy with as many images in fewer, larger steps, without a viewer, and with images in host memory.

        Raises:
            ConfigError: several ranks cannot train with these options.
        """
        if not self.collective:
            return config
        check_options(config)
        config = shorten(config, self.count)
        config.vis = without_viewer(config.vis)
        # A copy of all images on each GPU could take more memory than its shard.
        config.pipeline.datamanager.cache_images = "cpu"
        CONSOLE.quiet = self.rank != 0
        if config.machine.device_type == "cuda":
            torch.cuda.set_device(self.rank)
        return config

    def share(
        self, state: FieldState, source: FieldSource, extensions: list[Extension], datamanager: Any, seed: int
    ) -> tuple[FieldSource, list[Extension]]:
        """Give all ranks the field and head of rank 0, and keep the shard of this rank.

        Args:
            state: as built, the same number of primitives on each rank.
            source: of one process.
            extensions: of one process.
            datamanager: gives each rank another view at a step.
            seed: seed of draws that all ranks must share, such as the image to evaluate.

        Returns:
            Source and extensions of the shards.
        """
        if not self.collective:
            return source, extensions
        shards = self.shards = Shards(state.device)
        take_shard(state, shards)
        random.seed(seed)
        cameras = datamanager.train_dataset.cameras
        timetable = Timetable(cameras, datamanager.view_of_step, state.device)
        sharded = ShardedField(shards, state.field, timetable)
        shards.changed = sharded.forget_plan
        datamanager.place = (shards.rank, shards.ranks)
        return sharded, [self._sharded(extension, len(cameras)) for extension in extensions]

    def _sharded(self, extension: Extension, num_images: int) -> Extension:
        if isinstance(extension, Densification):
            strategy = extension.strategy
            if isinstance(strategy, CappedStrategy):
                strategy.see_each_image_after_resets(-(-num_images // self.count))
            return ShardedDensification(strategy, self.shards)
        if isinstance(extension, (ScheduledPruning, FloaterRemoval)):
            extension.pruner = partial(RankPruner, shards=self.shards)
        if isinstance(extension, PhotoGains):
            extension.total = self.shards.summed
        if isinstance(extension, DenseStart):
            extension.found, extension.put = self.shards.by_first, partial(_put_block, shards=self.shards)
        return extension

    def optimizers(self, make: Callable[[], Optimizers], config: Any, groups: Any, names: list[str]) -> Optimizers:
        """The optimizers that ``make`` builds, or those for batches of one image a rank."""
        if not self.collective:
            return make()
        optimizers = SharedOptimizers(config.copy(), groups)
        scale_rates(optimizers, names, self.count)
        return optimizers

    def agree(self, state: FieldState) -> None:
        """Share what each rank has noted by itself: the focal lengths that the head was trained on."""
        if self.collective:
            state.trained_focal = self.shards.widest(state.trained_focal)

    def gathered(self, state: State, head: CompensationHead | None, names: list[str]) -> State | None:
        """The checkpoint of the whole field on rank 0, None on the others; warns if the copies of the head differ."""
        if not self.collective:
            return state
        apart = 0.0 if head is None else self.shards.apart(head.parameters())
        if apart != 0 and self.shards.rank == 0:
            warn(
                f"the heads of the ranks differ by up to {apart:.2g}, which is a bug of sundae; the checkpoint holds "
                "the head of the first rank, and resuming from it makes them equal"
            )
        return whole_state(state, self.shards, names)

    def part(self, loaded: State, names: list[str]) -> State:
        """The part of a checkpoint that this rank holds.

        Raises:
            CheckpointError: the checkpoint holds no primitives.
        """
        return state_of_rank(loaded, self.shards.rank, self.count, names) if self.collective else loaded

    def restored(self, state: FieldState, seed: int, step: int) -> None:
        """Share the counts, and give each rank random numbers of its own."""
        if self.collective:
            self.shards.recount(state.field)
            torch.manual_seed(seed + step * self.count + self.shards.rank)


def take_shard(state: FieldState, shards: Shards) -> None:
    """Give all ranks the field and the head of rank 0, and keep this rank's block of the field. Collective."""
    for value in [] if state.head is None else [*state.head.parameters(), *state.head.buffers()]:
        dist.broadcast(value.data, 0)
    _take_block(state, shards)


def _take_block(state: FieldState, shards: Shards) -> None:
    for value in state.field.values():
        dist.broadcast(value.data, 0)
    start, end = bounds(state.field.num_primitives, shards.ranks)[shards.rank : shards.rank + 2]
    for value in state.field.values():
        value.data = value.data[start:end].clone()
    shards.recount(state.field)


def _put_block(state: FieldState, params: Mapping[str, Tensor], *, shards: Shards) -> None:
    """Replace the field by this rank's rows of a new one, which has equally many rows on all ranks. Collective."""
    put(state, params)
    _take_block(state, shards)
