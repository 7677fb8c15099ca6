"""The field under search: its PSNR on held-out views, its contribution, cuts, its head, and returns to snapshots."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sundae_ns.compensation import HeadConfig
from sundae_ns.errors import DataError
from sundae_ns.gaussians import FEATURES, finite_mask
from sundae_ns.gaussians.field import Field
from sundae_ns.gaussians.sh_folding import fold_harmonics, mean_basis, view_dependence
from sundae_ns.gaussians.surgery import narrow
from sundae_ns.pruning.cutting import FieldPruner
from sundae_ns.rasterization.harmonics import harmonic_basis
from sundae_ns.rendering.contribution import contribution, weights_by_batch
from sundae_ns.rendering.source import TrainingView
from sundae_ns.storage import bytes_of, stored_bytes
from sundae_ns.training.budget import heads
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
BISECTIONS = 6
"""Steps of the bisection for the number of view-independent primitives."""


@dataclass(frozen=True)
class SearchedField:
    """What a step of the search does to the field of a run."""

    run: TrainingRun
    config: PruningConfig
    search: SearchProgress
    engine: TrialEngine
    """Keeps the fields that the search may go back to."""
    largest: HeadConfig | None
    """The largest head that may be enabled; None for none."""

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
    def row(self) -> int:
        """Bytes of a primitive without features."""
        return bytes_of({name: value[:1] for name, value in self.field.items() if name != FEATURES})

    @property
    def stored(self) -> int:
        """Bytes of the field, with the head if it is enabled."""
        head = self.state.head if self.search.head else None
        return self.count * self.row if head is None else stored_bytes(self.field, head.config)

    @property
    def steps_left(self) -> int:
        """Training steps to come; without a trainer, those until the search has to end."""
        last = self.run.last_step
        return self.config.stop - self.state.schedule_step if last is None else last - self.state.step

    def evaluation(self, psnr: float, phase: str, verdict: str) -> Point:
        """A point of the curve for the present field."""
        state, age = self.state, self.state.schedule_step - self.search.cut_at
        return Point(state.step, phase, self.count, self.stored, psnr, verdict, age)

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

    def drop_nonfinite(self) -> int:
        """Remove primitives with a NaN or infinite parameter; returns their number, 0 if no primitive is finite."""
        pruner = FieldPruner(self.field, self.state.optimizers)
        return self._count_dropped(pruner.drop_nonfinite() if finite_mask(self.field).any() else 0)

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
        state, step = self.state, self.state.schedule_step
        rule, pruner = replace(self.config, seed=self.config.seed + step), FieldPruner(self.field, state.optimizers)
        report = prune_to(lambda n: min(count, n), rule, pruner, state.pruning, step, self.contribution)
        self._count_dropped(report.dropped_nonfinite)

    def lower_degree(self, degree: int) -> None:
        """Drop the SH coefficients above ``degree``; their mean over the views moves into the constant colour."""
        dc, rest = self.field["features_dc"], self.field["features_rest"]
        mean, _ = self.mean_basis(self.field.sh_degree)
        dc.data.copy_(fold_harmonics(dc.data, rest.data, mean, degree)[0])
        narrow(self.field, self.state.optimizers, "features_rest", (degree + 1) ** 2 - 1)
        self.search.degree = degree

    def flatten(self, least: float) -> Tensor:
        """Give view-independent colours to as many primitives as held-out views allow, the least view-dependent first.

        Args:
            least: mean PSNR over the held-out views to keep, dB.

        Returns:
            True for the primitives whose higher coefficients are now 0, bool ``[N]``.
        """
        dc, rest = self.field["features_dc"].data, self.field["features_rest"].data
        weight = self.contribution()
        mean, square = self.mean_basis(self.field.sh_degree)
        order = view_dependence(rest, mean, square, weight).cpu().argsort(stable=True).to(rest.device)
        colors, coefficients = dc.clone(), rest.clone()
        folded, _ = fold_harmonics(colors, coefficients, mean, 0)

        def flattened(count: int) -> Tensor:
            flat = torch.zeros(len(order), dtype=torch.bool, device=rest.device)
            flat[order[:count]] = True
            dc.copy_(torch.where(flat[:, None], folded, colors))
            rest.copy_(coefficients * ~flat[:, None, None])
            return flat

        low, high = 0, len(order)
        for _ in range(BISECTIONS):
            middle = (low + high + 1) // 2
            flattened(middle)
            low, high = (middle, high) if self.measure() >= least else (low, middle)
        return flattened(low)

    def keep(self, name: str) -> None:
        """Keep a copy of the field, and of the head if it is enabled."""
        self.engine.keep(name, self.state, head=self.search.head)

    def go_back(self, name: str) -> None:
        """Continue with a kept copy; rates and steps go on."""
        self.engine.go_back(name, self.state, rates=False)
        self.state.pruning["num_prunes"] += 1  # what is cached by this number is stale
        self.search.degree = self.field.sh_degree

    def restart_rates(self, *, head: bool) -> None:
        """Restart the learning rates of the field, or those of the head."""
        schedulers = self.state.schedulers
        restarted = {name: value for name, value in schedulers.items() if (name == "compensation") == head}
        notify_pruned(restarted, self.state.step, self.count)

    def head_for(self, primitives: int) -> HeadConfig | None:
        """The head that is small beside ``primitives`` of this field; None for none."""
        return None if self.largest is None else heads.head_for(primitives, self.row, self.largest)

    def enable_head(self, config: HeadConfig) -> None:
        """Enable a head, with features of its width."""
        state, search = self.state, self.search
        assert state.head is not None
        search.head, search.head_size, search.num_features = True, config.size, config.num_features
        if config != state.head.config:
            state.head.resize(config)
            narrow(state.field, state.optimizers, FEATURES, config.num_features)
        self.engine.enable_head(state, True)
        CONSOLE.log(f"a {config.size} head is enabled, with {config.num_features} features a primitive")
        self.restart_rates(head=True)

    def remove_head(self) -> None:
        """Remove head and features for good, if the field was made with them."""
        if self.largest is not None:
            self.state.remove_head()
            self.search.head_dropped, self.search.head_size, self.search.num_features = True, "", 0
