"""The field under search: its PSNR on held-out views, its contribution, cuts, and returns to snapshots."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.gaussians import FEATURES, finite_mask
from sundae_ns.gaussians.field import Field
from sundae_ns.gaussians.sh_folding import mean_basis
from sundae_ns.pruning.cutting import FieldPruner
from sundae_ns.rasterization.harmonics import harmonic_basis
from sundae_ns.rendering.contribution import contribution, weights_by_batch
from sundae_ns.rendering.source import TrainingView
from sundae_ns.storage import bytes_of, stored_bytes
from sundae_ns.training.budget.search import NO_IMAGE, Point, SearchProgress
from sundae_ns.training.extension import TrainingRun
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.pruning_config import PruningConfig
from sundae_ns.training.schedulers import notify_pruned
from sundae_ns.training.schedules import prune_to
from sundae_ns.training.trials.engine import TrialEngine
from sundae_ns.training.warning import warn

MAX_VIEWS = 64
"""Training views, evenly chosen, for each score: a search scores the field at every cut."""


@dataclass(frozen=True)
class SearchedField:
    """What a step of the search does to the field of a run."""

    run: TrainingRun
    config: PruningConfig
    search: SearchProgress
    engine: TrialEngine
    """Keeps the fields that the search may go back to."""

    @property
    def state(self) -> FieldState:
        """The field in training."""
        return self.run.state

    @property
    def field(self) -> Field:
        """Its parameters."""
        return self.run.state.field

    @property
    def count(self) -> int:
        """Number of primitives."""
        return self.field.num_primitives

    @property
    def _pruner(self) -> FieldPruner:
        return FieldPruner(self.field, self.state.optimizers)

    @property
    def bare(self) -> dict[str, Tensor]:
        """Parameters without features."""
        return {name: value for name, value in self.field.items() if name != FEATURES}

    @property
    def row(self) -> int:
        """Bytes of a primitive without features."""
        return bytes_of({name: value[:1] for name, value in self.bare.items()})

    @property
    def stored(self) -> int:
        """Bytes of the field, with the head if it is enabled."""
        head = self.state.head
        return stored_bytes(self.field, head.config) if self.search.head and head else stored_bytes(self.bare, None)

    @property
    def steps_left(self) -> int:
        """Training steps to come; without a trainer, those until the search has to end."""
        last = self.run.last_step
        return self.config.stop - self.state.schedule_step if last is None else last - self.state.step

    # ------------------------------------------------------------------------------------------------------- views

    def _views(self) -> list[TrainingView]:
        views = self.run.training_views()
        return views[:: -(-len(views) // MAX_VIEWS)]

    def contribution(self, count: int | None = None) -> Tensor:
        """Blending weights over some training views ``[N]``; see :func:`sundae_ns.rendering.contribution`."""
        return contribution(self.run.source, self._views(), self.run.background, self.run.settings, count)

    @torch.no_grad()
    def mean_basis(self, degree: int) -> tuple[Tensor, Tensor]:
        """Means and mean products of the SH basis up to ``degree`` over the views that see each primitive."""

        def weighted() -> Iterator[tuple[Tensor, Tensor]]:
            run, means = self.run, self.field["means"].data
            for _, view, _, weights in weights_by_batch(run.source, self._views(), run.background, run.settings):
                directions = torch.nn.functional.normalize(means - view.center, dim=-1)
                yield weights, harmonic_basis(degree, directions)

        return mean_basis(weighted())

    def measure(self) -> float:
        """Mean PSNR over the held-out views, dB; with the head if it is enabled. Always finite.

        An image that is not finite counts as ``NO_IMAGE``. Masked pixels do not count.

        Raises:
            DataError: masks leave no pixel.
        """
        views = self.engine.measure(self.run, with_ssim=False)
        if not views:
            raise DataError(
                "masks leave no pixel of the held-out views; mend the masks, or hold out other views with "
                "--pipeline.datamanager.holdout-every"
            )
        value = statistics.fmean(view.psnr for view in views)
        return value if math.isfinite(value) else NO_IMAGE

    def measure_finite(self) -> float:
        """:meth:`measure`; without primitives that are not finite, if they spoil it."""
        value = self.measure()
        if value > NO_IMAGE or not self.drop_nonfinite():
            return value
        self.search.accepted = self.count
        return self.measure()

    def evaluation(self, psnr: float, phase: str, verdict: str) -> Point:
        """A point of the curve for the field as it is."""
        state = self.state
        return Point(
            state.step, phase, self.count, self.stored, psnr, verdict, state.schedule_step - self.search.cut_at
        )

    # ------------------------------------------------------------------------------------------------------- fields

    def drop_nonfinite(self) -> int:
        """Remove primitives with a NaN or infinite parameter; returns their number, 0 if no primitive is finite."""
        return self._count_dropped(self._pruner.drop_nonfinite() if finite_mask(self.field).any() else 0)

    def _count_dropped(self, count: int) -> int:
        self.search.dropped_nonfinite += count
        if count:
            warn(f"removed {count} primitives that were not finite")
        return count

    def cut_to(self, count: int) -> None:
        """Keep ``count`` primitives by the configured rule, or all that are finite if there are fewer.

        Raises:
            DataError: the field cannot be scored.
        """
        step = self.state.schedule_step
        rule = replace(self.config, seed=self.config.seed + step)
        report = prune_to(lambda n: min(count, n), rule, self._pruner, self.state.pruning, step, self.contribution)
        self._count_dropped(report.dropped_nonfinite)

    def keep(self, name: str) -> None:
        """Keep a copy of the field, and of the head if it is enabled."""
        self.engine.keep(name, self.state, head=self.search.head)

    def go_back(self, name: str) -> None:
        """Continue with a kept copy; rates and steps go on."""
        self.engine.go_back(name, self.state, rates=False)
        # Whatever is cached by the number of prunes is stale.
        self.state.pruning["num_prunes"] += 1
        self.search.degree = self.field.sh_degree

    def restart_rates(self, *, head: bool) -> None:
        """Restart the learning rates of the field, or those of the head."""
        schedulers = self.state.schedulers
        restarted = {name: value for name, value in schedulers.items() if (name == "compensation") == head}
        notify_pruned(restarted, self.state.step, self.state.field.num_primitives)
