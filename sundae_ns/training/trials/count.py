"""The decision how many primitives a field keeps, by trials of several counts (``pruning.keep_ratio`` left out).

Some training views are held out from the first step to the decision: a large field remembers for long what it has seen
once. From the unpruned field trials of one length follow, each pruned to another count, with rates that decay as those
of a whole run. Where quality levels off, more primitives are not worth their bytes; where it still climbs, fewer would
lose what can be seen (:mod:`sundae_ns.training.trials.curve`).

Where quality levels off, a head is the only thing that gains more. It shows what it gains the sooner, the fewer
primitives there are: so two more trials, without and with it, train the usual share of the primitives if more than that
are chosen. The field then goes back to before the prune, and the schedule prunes it to the chosen count. Test views
are never used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, NamedTuple

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sundae_ns.errors import PackError
from sundae_ns.evaluation.count_curve import CURVE, CurvePoint, curve_table
from sundae_ns.gaussians.gaussians import FEATURES
from sundae_ns.pruning import kept_count
from sundae_ns.pruning.decision import FieldPruner
from sundae_ns.rendering.render import contribution
from sundae_ns.storage.coordinates import scene_order
from sundae_ns.storage.pack.scene import PackedScene, fit_scene, pack_bytes
from sundae_ns.training.densification import Densification
from sundae_ns.training.extension import Extension, TrainingRun
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.heldout import HeldOutQuality, from_values, mean_quality
from sundae_ns.training.pruning_config import USUAL_SHARE, PruningConfig
from sundae_ns.training.report import write_record
from sundae_ns.training.schedulers import limit_rise, notify_pruned
from sundae_ns.training.schedules import COUNT, prune_to
from sundae_ns.training.trials.curve import (
    HeadGain,
    Tolerance,
    affordable,
    choose,
    curve_of,
    head_pays,
    is_lost,
    still_climbs,
    with_head,
)
from sundae_ns.training.trials.engine import Trial, TrialEngine
from sundae_ns.training.trials.head import (
    HELD_OUT_EVERY,
    MEAN_SHARE,
    MOST_HELD_OUT,
    RISE_SHARE,
    TrialPlan,
    plan_trials,
    spread_views,
)
from sundae_ns.training.warning import warn

SHARES = (1.0, 0.4, 0.2, 0.1, 0.05, 0.025)
"""Shares of the primitives that are tried, about a factor of 2 apart, largest first."""
TRIAL_SHARE = 0.02
"""Length of a trial as a share of the schedule."""
LEAST_VIEWS = 32
"""With fewer training views, those that could be held out are too few to compare counts."""
MOST_VIEWS = 32
"""Most training views that the prune of a trial looks at."""
MOST_TRIALS = 0.45
"""Largest share of the steps after the prune that all trials may take."""
SAMPLE = 1 << 13
"""Neighbouring primitives that are packed to estimate the bytes of a field."""
FULL = "full"
"""Name of the copy of the unpruned field."""


@dataclass
class CountTrialProgress:
    """Numbers of a decision; plain values, for checkpoints."""

    phase: str = "before"
    """before, holding (views are held out), trials, or done."""
    steps: int = 0
    """Length of the schedule when training started: a resumed run may be longer or shorter, its trials may not."""
    full: int = 0
    """Number of primitives before the prune."""
    counts: list[int] = field(default_factory=list)
    """Number of primitives of each begun trial."""
    sizes: list[int | None] = field(default_factory=list)
    """Estimated bytes of the packed field of each finished trial."""
    measured: list[list[list[float]]] = field(default_factory=list)
    """For each finished trial and held-out view: the values of a :class:`HeldOutQuality`."""
    tries_head: bool = False
    """Whether the trials of counts have ended, and the present one is for the head."""
    head: list[list[list[float]]] = field(default_factory=list)
    """The same as in ``measured`` for the finished trials without and with a head."""
    head_bytes: list[list[int] | None] = field(default_factory=list)
    """Estimated bytes of both packed fields, and of the head of each; None if they cannot be packed."""
    head_pays: bool | None = None
    """Whether the head gains enough; None without trials of it."""
    chosen: int = 0
    """The chosen number; 0 before the decision."""

    def curve(self) -> list[CurvePoint]:
        """The points of the finished trials, largest count first, with a head if it pays.

        There are none if masks leave no pixel of the views.
        """
        curve = self.plain_curve()
        return with_head(curve, self.head_gain()) if curve and self.head_pays else curve

    def plain_curve(self) -> list[CurvePoint]:
        """The same without a head."""
        done = len(self.measured)
        return curve_of(self.counts[:done], self.measured, self.sizes) if done and self.measured[0] else []

    def head_gain(self) -> HeadGain:
        """What both trials of the head have shown."""
        plain, head = (mean_quality(from_values(trial)) for trial in self.head)
        gain = HeadGain.of(kept_count(USUAL_SHARE, self.full), plain, head)
        if len(self.head_bytes) == 2 and None not in self.head_bytes:
            (fewer, _), (more, fixed) = self.head_bytes  # type: ignore[misc]
            gain = gain._replace(features=more - fewer, head=fixed)
        return gain


class CountTrials(Extension):
    """Decides how many primitives the prune keeps.

    Args:
        config: options of pruning.
        densification: its running state starts anew when the trials begin.
        engine: carries out the trials.
        alone: whether no other extension saves the state of the engine and enables the head.
    """

    name = "count"

    def __init__(
        self, config: PruningConfig, densification: Densification, engine: TrialEngine, *, alone: bool
    ) -> None:
        self.config = config
        self.progress = CountTrialProgress()
        self._densification = densification
        self._engine = engine
        self._alone = alone

    def state_dict(self) -> dict[str, Any]:
        """Numbers of the decision, and the state of the engine if nothing else saves it."""
        return {"numbers": asdict(self.progress), **({"engine": self._engine.state_dict()} if self._alone else {})}

    def load_state_dict(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Counterpart of :meth:`state_dict`. A run that was pruned before this extension existed is decided.

        Raises:
            CheckpointError: the checkpoint lacks the field to which the trials return.
        """
        known, numbers = {one.name for one in fields(CountTrialProgress)}, saved.get("numbers", {})
        self.progress = CountTrialProgress(**{name: value for name, value in numbers.items() if name in known})
        measured = self.progress.measured
        if measured and measured[0] and isinstance(measured[0][0][0], list):
            # Earlier versions measured a trial in the middle, too, and noted the trial when it began.
            self.progress.measured = [trial[-1] for trial in measured[: len(self.progress.sizes)]]  # type: ignore[misc]
        if self._alone and "engine" in saved:
            self._engine.load_state_dict(state, saved["engine"])
        if self.progress.phase == "trials" and self._alone:
            self._engine.require(FULL)

    def before_training(self, run: TrainingRun) -> None:
        """Hold views out, or take the usual share where trials cannot decide."""
        progress, state, views = self.progress, run.state, len(run.view_indices())
        progress.steps = progress.steps or (run.schedule_length or 0) + state.offset
        if progress.phase == "done" or state.pruning["num_prunes"] and progress.phase != "trials":
            progress.phase = "done"
        elif run.images_per_step > 1:
            self._take_usual(run, "trials of counts need a single GPU")
        elif state.offset:
            self._take_usual(run, "a warm start has seen all training views before")
        elif views < LEAST_VIEWS:
            self._take_usual(run, f"{views} training views are too few to compare counts")
        elif not self._fits(run):
            self._take_usual(run, "the steps after the prune are too few to compare counts")
        elif progress.phase == "trials":
            self._engine.enable_head(state, len(progress.head) == 1)
            self._engine.resume(run)
        else:
            progress.phase = "holding"
            self._engine.hold(run, self.name, self._views(run))

    def after_step(self, run: TrainingRun) -> None:
        """Begin and end trials, decide."""
        progress = self.progress
        if progress.phase == "holding" and run.state.schedule_step >= self.config.prune_at:
            self._begin(run)
        elif progress.phase == "trials" and self._engine.after_step(run):
            self._end_trial(run)

    def head_pays(self) -> bool | None:
        """Whether the trials have found that a head pays; None if they leave that to others."""
        return self.progress.head_pays

    @property
    def _tolerance(self) -> Tolerance:
        return Tolerance.of_drop(self.config.max_drop)

    @property
    def _length(self) -> int:
        return max(round(TRIAL_SHARE * self.progress.steps), 1)

    def _views(self, run: TrainingRun) -> list[int]:
        indices = run.view_indices()
        return spread_views(indices, min(MOST_HELD_OUT, len(indices) // HELD_OUT_EVERY), 0)

    def _plan(self, run: TrainingRun) -> TrialPlan:
        """The trials of the head: on the views that it would hold out for trials of its own."""
        return plan_trials(run.view_indices(), self.progress.steps)

    def _fits(self, run: TrainingRun) -> bool:
        """Whether the trials leave enough of the steps after the prune."""
        steps = 0 if run.last_step is None else max(run.last_step + 1, run.schedule_length or 0)
        head = 0 if self._alone else 2 * self._plan(run).length
        return len(SHARES) * self._length + head <= MOST_TRIALS * (steps - self.config.prune_at)

    def _begin(self, run: TrainingRun) -> None:
        progress, state = self.progress, run.state
        FieldPruner(state.field, state.optimizers, [state.densification]).drop_nonfinite()
        self._densification.initialize(state)  # its statistics would not match the field that comes back
        progress.phase, progress.full = "trials", run.source.total
        CONSOLE.log(
            f"step {state.step}: how many primitives does the scene need? Up to {len(SHARES)} trials of "
            f"{self._length:,} steps; {len(self._views(run))} of {len(run.view_indices())} training views "
            "are held out"
        )
        self._engine.enable_head(state, False)
        self._engine.keep(FULL, state, head=not self._alone)
        self._start_trial(run)

    def _start_trial(self, run: TrainingRun) -> None:
        """Train the next count."""
        progress, state = self.progress, run.state
        count = max(round(SHARES[len(progress.counts)] * progress.full), 1)
        self._prune(run, count)
        notify_pruned(state.schedulers, state.step, count, last=False, ends_at=state.step + self._length)
        progress.counts.append(count)
        trial = Trial(self._length, self._views(run), averaged=MEAN_SHARE * self._length, counts=False)
        self._engine.start(run, trial)

    def _start_head_trial(self, run: TrainingRun) -> None:
        """Train the usual share, first without a head, then with one."""
        progress, state, plan = self.progress, run.state, self._plan(run)
        assert state.head is not None
        progress.tries_head = True
        count, width = kept_count(USUAL_SHARE, progress.full), state.head.config.num_features
        self._prune(run, count)
        limit_rise(state.schedulers, round(RISE_SHARE * plan.length))
        notify_pruned(state.schedulers, state.step, count, last=False)
        trial = Trial(plan.length, plan.views, averaged=MEAN_SHARE * plan.length, counts=False)
        self._engine.start(run, replace(trial, num_features=width if progress.head else 0))

    def _prune(self, run: TrainingRun, count: int) -> None:
        """Prune the field as the schedule would, by fewer views."""
        state = run.state

        def contribute(kept: int | None) -> Tensor:
            views = run.training_views()
            return contribution(run.source, views[:: -(-len(views) // MOST_VIEWS)], run.background, run.settings, kept)

        pruner = FieldPruner(state.field, state.optimizers, [state.densification])
        prune_to(lambda n: min(count, n), self.config, pruner, state.pruning, state.schedule_step, contribute)

    def _end_trial(self, run: TrainingRun) -> None:
        """Measure; start the next trial from the unpruned field, or decide."""
        progress, state = self.progress, run.state
        if progress.tries_head:
            progress.head.append([list(view) for view in self._engine.measure(run)])
            size = packed_size(state.field, state.head if state.head_enabled else None)
            progress.head_bytes.append(None if size is None else list(size))
            if len(progress.head) == 2:
                progress.head_pays = head_pays(progress.plain_curve(), progress.head_gain(), self._tolerance)
        else:
            progress.measured.append([list(view) for view in self._engine.measure(run, with_fitted=True)])
            size = packed_size(state.field)
            progress.sizes.append(None if size is None else size.field)
        self._engine.go_back(FULL, state)
        self._engine.enable_head(state, False)
        curve = progress.curve()
        more = len(progress.counts) < len(SHARES) and curve and not is_lost(curve[-1], self._tolerance)
        if more and not progress.tries_head:
            self._start_trial(run)
        elif self._asks_for_head(curve):
            self._start_head_trial(run)
        else:
            self._decide(run, curve)

    def _asks_for_head(self, curve: list[CurvePoint]) -> bool:
        """Whether a trial of the head is due: where the usual share is kept, others try it as in any run."""
        if self._alone or not curve or len(self.progress.head) == 2:
            return False
        return self._choice(curve)[0] > kept_count(USUAL_SHARE, self.progress.full)

    def _choice(self, curve: list[CurvePoint]) -> tuple[int, str]:
        """The chosen count, and why."""
        config = self.config
        count, reason = choose(curve, self._tolerance), "the fewest that are as good as the best"
        limits = {"max-primitives": config.max_primitives}
        if config.max_bytes is not None:
            limits["max-bytes"] = affordable(curve, config.max_bytes)
        for name, most in limits.items():
            if most is not None and most < count:
                count, reason = most, f"the most that pruning.{name} allows"
        return count, reason

    def _decide(self, run: TrainingRun, curve: list[CurvePoint]) -> None:
        """Choose a count, and let the schedule prune to it."""
        progress = self.progress
        if not curve:
            self._take_usual(run, "masks leave no pixel of the held-out training views")
            return
        count, reason = self._choice(curve)
        self._settle(run, count)
        self._show(curve, reason)
        if still_climbs(curve, self._tolerance):
            CONSOLE.log(
                "quality still grows at the full count: the scene may need more primitives than densification made; "
                "a lower --pipeline.model.densify-grad-thresh makes more"
            )
        names = HeldOutQuality._fields
        points = [
            {**asdict(point), "measured": [dict(zip(names, view, strict=True)) for view in trial]}
            for point, trial in zip(curve, progress.measured, strict=True)
        ]
        run.log_scalars("Curve", {"chosen": count, "full": progress.full})
        record: dict[str, Any] = {"chosen": count, "full": progress.full, "reason": reason, "step": run.state.step}
        record |= {"tolerance": self._tolerance._asdict(), "held_out_views": self._views(run)}
        record |= {"steps_per_trial": self._length, "curve": points}
        if progress.head_pays is not None:
            qualities = map(mean_quality, map(from_values, progress.head))
            figures = dict(zip(("plain", "head"), qualities, strict=True))
            CONSOLE.log(
                f"a tenth of the primitives after {self._plan(run).length:,} steps: "
                + "; ".join(f"{name} {psnr:.2f} dB, SSIM {ssim:.4f}" for name, (psnr, ssim) in figures.items())
            )
            shown = {name: dict(zip(("psnr", "ssim"), one, strict=True)) for name, one in figures.items()}
            record["head"] = {"pays": progress.head_pays, "steps_per_trial": self._plan(run).length, **shown}
        write_record(run, CURVE, record)

    def _show(self, curve: list[CurvePoint], reason: str) -> None:
        """The curve as a table in the log."""
        CONSOLE.log("expected at the end, on held-out training views:", *curve_table(curve), sep="\n")
        CONSOLE.log(f"keeping {self.progress.chosen:,} of {self.progress.full:,} primitives: {reason}")

    def _take_usual(self, run: TrainingRun, reason: str) -> None:
        """Keep the usual share."""
        warn(
            f"pruning keeps {USUAL_SHARE:.0%} of the primitives: {reason}; --pipeline.model.pruning.keep-ratio sets it"
        )
        self._settle(run, None)

    def _settle(self, run: TrainingRun, count: int | None) -> None:
        """End the trials; without a count the schedule keeps the usual share."""
        progress, state = self.progress, run.state
        progress.phase, progress.chosen = "done", count or 0
        state.pruning[COUNT] = count or 0
        self._engine.end(run, self.name)
        if self._alone:
            self._engine.enable_head(state, True)


class PackedSize(NamedTuple):
    """Estimated bytes of a packed scene."""

    field: int
    """Of the primitives, with features if there is a head."""
    head: int
    """Of the head; 0 without one."""


def packed_size(field: Mapping[str, Tensor], head: torch.nn.Module | None = None) -> PackedSize | None:
    """Estimate the bytes of a packed scene by packing neighbouring primitives; None if it cannot be packed.

    Args:
        field: parameters by name ``[N, ...]``.
        head: the head that reads the features; None leaves them out.
    """
    n = len(field["means"])
    packed = {name: value.detach() for name, value in field.items() if head is not None or name != FEATURES}
    if n > SAMPLE:
        order = scene_order(packed["means"].float().cpu().numpy())
        middle = torch.from_numpy(order[(n - SAMPLE) // 2 :][:SAMPLE])
        packed = {name: value[middle.to(value.device)] for name, value in packed.items()}
    weights = {} if head is None else {name: value.float().cpu() for name, value in head.state_dict().items()}
    try:
        sample = PackedScene({name: value.float().cpu() for name, value in packed.items()}, weights)
        data, sections = pack_bytes(*fit_scene(sample))
    except PackError:
        return None
    fixed = sum(size for name, size in sections.items() if name.startswith("head/"))
    return PackedSize(round((len(data) - fixed) * n / min(n, SAMPLE)), fixed)
