"""Trials: train candidates (count x head x length) for some steps, measure held-out training views, keep the best.

The stages of a run follow each other. Each tries its candidates in turn, from the same Gaussians, until one does not
pay:

``count``
    How many Gaussians the prune keeps (``pruning.keep_ratio`` left out), smaller ones in turn. Views are held out from
    the first step: many Gaussians remember for long what they have seen once. Few views decide by their number alone:
    what they would tell is less than what the training loses without them.
``tenth``
    If more than the usual share is chosen, or bytes are limited, that share is trained without and with a head: there
    it gains the sooner.
``head``
    Whether training continues plain, with a head, or with one of more features (``head.mode auto``), unless ``tenth``
    has decided. Where views are few or differ, a head fits their differences. The chosen trial continues.
``length``
    How long few views are trained on. The views of the last trial stay held out. Once their loss grows, training goes
    back (stage ``repeat``), takes as many steps on all views as were best, and is paused.

The mean of the weights over the last steps of a trial renders the held-out views: the weights of a single step fit the
last images best. Test views are never used. :mod:`sundae_ns.train.choice` has the rules.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from sundae_ns.core.errors import CheckpointError, PackError
from sundae_ns.core.gaussians import FEATURES
from sundae_ns.core.metrics import MOST_PSNR, SSIM_WINDOW, fitted_psnr, psnr, ssim
from sundae_ns.core.surgery import replace_parameter
from sundae_ns.head.head import stored_bytes
from sundae_ns.io.coordinates import scene_order
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene, pack_bytes
from sundae_ns.pruning.rule import kept_count
from sundae_ns.scene.render import render_view
from sundae_ns.scene.scene import initial_features
from sundae_ns.train import choice
from sundae_ns.train.averaging import AVERAGED_EVERY, RunningMean, weights_of
from sundae_ns.train.choice import HEADS, HeadGain, HeldOutQuality, Tolerance, Tried, mean_quality
from sundae_ns.train.curve import RECORD, CurvePoint, curve_table
from sundae_ns.train.densification import Densification
from sundae_ns.train.pruning import COUNT, MANY_VIEWS, USUAL_SHARE, VIEWS, prune_to, usual_share, write_record
from sundae_ns.train.schedules import limit_rise, notify_pruned, put_restarts, restarts
from sundae_ns.train.state import HEAD, Callback, TrainingRun, TrainingState

_log = logging.getLogger(__name__)

COUNTS = ("count", "tenth")  # Stages that decide the number of Gaussians
SHARES: tuple[float, ...] = (1.0, 0.4, 0.2, 0.1, 0.05, 0.025)  # Of the Gaussians that are tried
COUNT_SHARE = 0.02  # Length of a trial of a count, and of a window of a length, as a share of the schedule
FEWEST_VIEWS = 6  # Fewer cannot judge a head
LARGEST_HEAD = 2.0  # Stored bytes of a head as a multiple of those of a pack, where an eighth of it takes a quarter
MOST_CONTRIBUTING = 32  # Training views that the prune of a trial looks at
MOST_TRIALS = 0.45  # Largest share of the steps after the prune that trials of counts, and of a head in them, may take
MEAN_SHARE = 0.25  # Share of a trial, at its end, over which weights are averaged
RISE_SHARE = 5 / 12  # Share of a trial, at its beginning, over which the learning rate of the head may rise
HOLD_SHARE = 0.1  # Share of the schedule for which views are held out before trials of a head, so that it forgets them
WATCHED_SHARE = 0.5  # Longest watch of the length, as a share of the steps after the decision about the head
MORE_FEATURES = 29  # Of the last candidate: as many as are splatted without padding after the default 13
NAMES = {"plain": "no head", "head": "head", "features": f"head with {MORE_FEATURES} features"}
SAMPLE = 1 << 13  # Neighbouring Gaussians that are packed to estimate the bytes of all
_MASKED = "masks leave no pixel of the held-out training views"
_DISABLED = "so it stays disabled; train longer, or force it with --pipeline.model.head.mode residual"


# ------------------------------------------------------------------------------------------------------- measurement


@torch.no_grad()
def measure_held_out(run: TrainingRun, *, with_fitted: bool = False) -> list[HeldOutQuality]:
    """Quality of the held-out views, with the head if it is enabled; fully masked views are left out."""
    qualities = []
    for camera, target, mask in run.held_out_views():
        image = render_view(run.source, camera, run.background, run.settings, depth=False)[0]["rgb"]
        quality = view_quality(image, target, mask)
        if quality.pixels:
            fitted = float(fitted_psnr(image, target, mask)) if with_fitted else math.nan
            qualities.append(quality._replace(fitted=fitted))
    return qualities


def view_quality(image: Tensor, target: Tensor, mask: Tensor | None) -> HeldOutQuality:
    """Quality of an image ``[H, W, 3]`` under a mask, bool ``[H, W]``; None for all pixels."""
    pixels = target[..., 0].numel() if mask is None else int(mask.sum())
    if not pixels:
        return HeldOutQuality(0, 0.0, 0.0)
    # Outside of the mask the compared image is exact, so all of its error belongs to the pixels that count.
    compared = image if mask is None else torch.where(mask[..., None], image, target)
    share = pixels / target[..., 0].numel()
    decibels = float(psnr(compared, target)) + 10 * math.log10(share)
    similarity = 1 - (1 - float(ssim(compared, target))) / share if min(target.shape[:2]) >= SSIM_WINDOW else 0.0
    return HeldOutQuality(pixels, min(decibels, MOST_PSNR), similarity)


def packed_size(gaussians: Mapping[str, Tensor], head: torch.nn.Module | None = None) -> list[int] | None:
    """Estimated bytes of the Gaussians, without features if there is no head, and of the head in a packed scene.

    Neighbouring ones are packed as a sample. None if they cannot be packed.
    """
    n = len(gaussians["means"])
    rows = torch.arange(n)
    if n > SAMPLE and (means := gaussians["means"].detach().float().cpu()).isfinite().all():  # else none can be packed
        order, _ = scene_order(means.numpy())
        rows = torch.from_numpy(order[(n - SAMPLE) // 2 :][:SAMPLE])
    used = {name: value.detach() for name, value in gaussians.items() if head is not None or name != FEATURES}
    sample = {name: value[rows.to(value.device)].float().cpu() for name, value in used.items()}
    weights = {} if head is None else {name: value.float().cpu() for name, value in head.state_dict().items()}
    try:
        data, sections = pack_bytes(*fit_scene(PackedScene(sample, weights)))
    except PackError:
        return None
    fixed = sum(size for name, size in sections.items() if name.startswith("head/"))
    return [round((len(data) - fixed) * n / min(n, SAMPLE)), fixed]


# ------------------------------------------------------------------------------------------------------------ trials


@dataclass(frozen=True)
class Trial:
    """Options of a trial; plain values, for checkpoints."""

    length: int  # Training steps
    held_out: list[int] = field(default_factory=list)  # Indices of the training views that are held out
    averaged: float = 0  # Steps at its end over which weights are averaged; 0 measures the last weights
    num_features: int | None = None  # Width of the features; 0 disables the head, None changes nothing
    counts: bool = True  # Whether its Gaussians are kept in any case; those of others are TrainingState.provisional
    began: int = 0  # Step of the schedule at which it began


@dataclass
class Progress:
    """Where the trials of a run are; plain values, for checkpoints."""

    stage: str = ""  # The stage whose candidates are tried; empty between stages, and paused at the end of the last
    steps: int = 0  # Length of the schedule when training started; that of a resumed run may be another
    full: int = 0  # Number of Gaussians before the prune
    tried: list[Tried] = field(default_factory=list)  # All candidates after their trials
    chosen: dict[str, Any] = field(default_factory=dict)
    """By decided stage: ``count`` (0 for the usual share), ``tenth`` (whether the head pays), ``head``, and ``length``
    (steps on all views; None for all that are left)."""
    reason: str = ""  # Why the head was chosen without trials
    watched_until: int = 0  # Step of the schedule at which the trial of the length ends at the latest
    records: dict[str, Any] = field(default_factory=dict)  # What trials.json holds; a resumed run writes it again

    def of(self, stage: str) -> list[Tried]:
        """The candidates of a stage."""
        return [row for row in self.tried if row.stage == stage]


class Trials(Callback):
    """Tries candidates for the number of Gaussians, the head, and the length of the training.

    It acts before the schedule prunes; :class:`AfterPrune` calls it again afterwards, for the stages that follow. It
    decides about the count if the options leave it to trials, about the head in mode auto; a head stays disabled until
    its trial, after the step ``begins_at`` of the schedule. The running state of ``densification`` then starts anew.
    """

    name = "trials"

    def __init__(self, options: Any, state: TrainingState, densification: Densification, begins_at: float) -> None:
        self.config, self.ssim_weight = options.pruning, options.ssim_lambda
        self._tolerance = Tolerance.of_drop(self.config.max_drop)
        self.begins_at = begins_at
        self.decides_head = options.head.mode == "auto"
        self._head_at = begins_at if self.decides_head else state.head_starts_at  # Step after which it may be enabled
        self.progress = Progress()
        self.trial: Trial | None = None  # The current trial
        self.kept: dict[str, dict[str, Any]] = {}
        """Copies of the Gaussians by name: a :meth:`TrainingState.snapshot`, and the ``counted`` steps before it."""
        self.taken_back = 0  # Steps of trials whose Gaussians were dropped
        self.coming: dict[str, list[int]] = {}
        """Views that are held out for the trials to come of a stage. In a trial its own views are, and no others."""
        self._mean = RunningMean()
        self._window = 1  # Steps of a trial of a count, and between two measurements of a length
        self._judges: list[int] = []  # Views that are held out for the trials of counts
        self._folds: list[list[int]] = []  # Views that are held out for the trials of each head, one after another
        self._length = 1  # Steps of a trial of a head
        self._densification = densification
        width = 0 if state.head is None else state.head.config.num_features
        self._heads = HEADS if width < MORE_FEATURES else HEADS[:2]
        self._widths = dict(zip(HEADS, (0, width, MORE_FEATURES), strict=True))
        if self.decides_head:
            self.enable_head(state, False)

    def state_dict(self) -> dict[str, Any]:
        """What was tried and chosen, the current trial, and the copies to go back to; plain values and tensors."""
        engine = {"trial": self.trial and asdict(self.trial), "kept": self.kept, "taken_back": self.taken_back}
        engine |= {"coming": self.coming, **self._mean.state_dict()}
        return {"progress": asdict(self.progress), "engine": engine, "head": self.decides_head}

    def prepare_loading(self, state: TrainingState, saved: Mapping[str, Any]) -> None:
        """Give head and features the width of the checkpoint, or remove them; ``CheckpointError`` if it has none."""
        if not self.decides_head:
            return
        if not saved.get("head"):
            modes = "the checkpoint is of a run with head.mode residual, features or off"
            raise CheckpointError(f"{modes}; give this mode with --pipeline.model.head.mode")
        head, trial = saved["progress"]["chosen"].get("head"), saved["engine"]["trial"]
        if head == "features" or (trial and trial["num_features"] == MORE_FEATURES):
            state.widen_head(MORE_FEATURES)
            features = state.gaussians[FEATURES]
            features.data = features.data.new_zeros(len(features), MORE_FEATURES)
        elif head == "plain":
            state.remove_head()

    def load_state_dict(self, state: TrainingState, saved: Mapping[str, Any]) -> None:
        """Counterpart of :meth:`state_dict`; ``CheckpointError`` if Gaussians to go back to are missing."""
        if not saved:
            return
        engine = saved["engine"]
        tried = [Tried(**row) for row in saved["progress"]["tried"]]
        self.progress = progress = Progress(**{**saved["progress"], "tried": tried})
        if self.decides_head:
            self.enable_head(state, progress.chosen.get("head", "plain") != "plain")
        self.trial = None if engine["trial"] is None else Trial(**engine["trial"])
        self.kept = dict(engine["kept"])
        self.taken_back = engine["taken_back"]
        self.coming = dict(engine["coming"])
        self._mean = RunningMean.of(engine, state.device)
        self._apply(state)
        needed = ["start"] if progress.stage in (*COUNTS, "head", "length") else []
        needed += [row.head for row in tried if row.stage == progress.stage == "head"]
        if not all(isinstance(kept := self.kept.get(name), Mapping) and "head" not in kept for name in needed):
            raise CheckpointError("the checkpoint lacks a field that its trials would return to; give another")

    def trains(self, state: TrainingState) -> bool:
        """False while training is paused. It continues after the end of the schedule: the user has asked for more."""
        return self.progress.stage != "paused" or state.schedule_step >= self.progress.steps

    def before_training(self, run: TrainingRun) -> None:
        """Hold views out; decide at once where trials cannot."""
        progress, state = self.progress, run.state
        indices = run.view_indices()
        num_views, before = len(indices), state.pruning.get(VIEWS)
        state.pruning[VIEWS] = num_views
        # A warm start skips the steps before the prune.
        progress.steps = progress.steps or (run.schedule_length or 0) + state.offset
        self._window = max(round(COUNT_SHARE * progress.steps), 1)
        self._folds, self._length = choice.plan_heads(indices, progress.steps)
        self._judges = choice.spread_cameras(indices, min(choice.MOST_HELD_OUT, num_views // choice.HELD_OUT_EVERY), 0)
        for stages, decides in ((COUNTS, self.config.decides), (("head", "length"), self.decides_head)):
            if not decides or num_views != before:
                self._forget(run, stages)
        if self.config.decides and "count" not in progress.chosen:
            self._prepare_counts(run, num_views)
        if self.decides_head and "head" not in progress.chosen:
            self._prepare_heads(run, num_views)
        elif run.images_per_step > 1 and progress.stage in ("length", "repeat", "paused"):
            self._end_length(run, "", None)  # a length counts steps of one image
        self.hold_out(run)
        self._record(run)

    def _forget(self, run: TrainingRun, stages: tuple[str, str]) -> None:
        """Undo what has begun, as a resumed run may have other views, or options that leave nothing to decide."""
        self.coming.pop(stages[0], None)
        if self.progress.stage in stages:
            self.go_back("start", run.state)
            self.progress.stage = ""
            self.progress.tried = [row for row in self.progress.tried if row.stage not in stages]
            self.end(run, stages[0])
            self.enable_head(run.state, not self.decides_head)

    def _prepare_counts(self, run: TrainingRun, num_views: int) -> None:
        """Hold views out for trials of counts, or keep the usual share where there can be none."""
        progress, state = self.progress, run.state
        steps = len(SHARES) * self._window + (2 * self._length if self.decides_head else 0)
        left = _steps_of(run) - self.config.prune_at
        obstacles = {
            f"{num_views} training views are too few to compare counts": num_views < MANY_VIEWS,
            "trials of counts need a single GPU": run.images_per_step > 1,
            "a warm start has seen all training views before": state.offset > 0,
            "the steps after the prune are too few to compare counts": steps > MOST_TRIALS * left,
        }
        reason = next((reason for reason, holds in obstacles.items() if holds), None)
        if state.pruning["num_prunes"] and not progress.stage:  # by a share that was given
            progress.chosen["count"] = 0
        elif reason is not None:
            self._forget(run, COUNTS)  # one GPU may have begun them, and have pruned for a trial
            self._keep_usual(run, reason)
        else:
            self.coming["count"] = self._judges

    def _prepare_heads(self, run: TrainingRun, num_views: int) -> None:
        """Decide about the head where trials cannot, or warn if training ends before them."""
        progress, head = self.progress, run.state.head
        largest = LARGEST_HEAD * (self.config.max_bytes or math.inf)
        if run.images_per_step > 1:  # also if one GPU has begun them: its copies are of all Gaussians
            wide = head is not None and head.config.num_features == MORE_FEATURES
            self._finish_with(run, "features" if wide else "head", "trials need a single GPU")
        elif head is not None and stored_bytes({}, head.config) >= largest:
            self._finish_with(run, "plain", "in a pack it would take a quarter of pruning.max-bytes")
        elif num_views < FEWEST_VIEWS:
            self._finish_with(run, "plain", f"{num_views} training views are too few to tell whether a head helps")
        elif progress.stage != "head" and "head" not in self.coming and not self._heads_fit(run):
            if run.last_step is not None:
                _log.warning("training ends before the head can be tried, %s", _DISABLED)

    def after_step(self, run: TrainingRun) -> None:
        """Try counts, before the schedule prunes."""
        progress = self.progress
        if progress.stage in COUNTS:
            self._go_on(run)
        elif self.config.decides and "count" not in progress.chosen and run.state.schedule_step >= self.config.prune_at:
            self._begin_counts(run)

    def after_prune(self, run: TrainingRun) -> None:
        """Try heads and lengths, once the schedule has pruned."""
        progress, state, coming = self.progress, run.state, self.coming
        if not self.decides_head or progress.stage in (*COUNTS, "paused"):
            return
        if progress.stage:
            self._go_on(run)
        elif "head" not in progress.chosen:
            holds = state.schedule_step >= self.begins_at - HOLD_SHARE * progress.steps
            if "head" not in coming and holds and self._heads_fit(run):
                coming["head"] = sum(self._folds, [])
                self.hold_out(run)
            pruned = not self.config.decides or state.pruning["num_prunes"] > 0
            if "head" in coming and pruned and state.schedule_step >= self.begins_at:
                self._begin_heads(run)
        if not progress.stage and "head" in progress.chosen and "length" not in progress.chosen:
            self._begin_length(run)

    def finish(self, run: TrainingRun) -> None:
        """Warn if training ended before a decision."""
        undecided = self.decides_head and "head" not in self.progress.chosen
        if undecided and run.last_step is not None and run.last_step + 1 >= (run.schedule_length or 0):
            _log.warning("training ended before the head could be tried, %s", _DISABLED)

    def start(self, run: TrainingRun, stage: str, length: int, views: list[int], width: int | None = None) -> None:
        """Start a trial from the present Gaussians, which may be dropped if a width of the features is given."""
        state = run.state
        self.progress.stage = stage
        self._mean = RunningMean()
        averaged = self._window if width is None else MEAN_SHARE * length
        self.trial = Trial(length, views, averaged, width, width is None, state.schedule_step)
        self.hold_out(run)
        self._apply(state)
        if not width:
            return
        if state.widen_head(width):
            state.optimizers[HEAD].state.clear()
            generator = torch.Generator().manual_seed(0)
            features = initial_features(state.gaussians["features_dc"].detach(), width, generator)
            replace_parameter(state.gaussians, state.optimizers, FEATURES, features, {})
        # Now: the callback that prunes acts before, so it would be a step later.
        notify_pruned(state.schedulers, state.step, run.source.total)

    def _apply(self, state: TrainingState) -> None:
        """Enable the head as the trial has it, and say whether the Gaussians may be dropped."""
        if self.trial is not None and self.trial.num_features is not None:
            self.enable_head(state, self.trial.num_features > 0)
        state.provisional = self.trial is not None and not self.trial.counts

    def enable_head(self, state: TrainingState, enabled: bool) -> None:
        """Enable or disable the head."""
        # Not from this step on: a run that is resumed on several GPUs counts other steps.
        state.head_starts_at = self._head_at if enabled else math.inf

    def hold_out(self, run: TrainingRun) -> None:
        """Hold out the views of the current trial, or else those of the trials to come."""
        coming = {view for views in self.coming.values() for view in views}
        run.hold_out(sorted(coming) if self.trial is None else self.trial.held_out)

    def advance(self, run: TrainingRun) -> bool:
        """Average the weights if it is due; returns whether the current trial has ended."""
        trial, state = self.trial, run.state
        assert trial is not None
        left = trial.began + trial.length - state.schedule_step
        if left < trial.averaged and state.step % AVERAGED_EVERY == 0:
            self._mean.count_in(weights_of(state))
        return bool(left <= 0)

    def keep(self, name: str, state: TrainingState, *, head: bool) -> None:
        """Keep a copy of the Gaussians, and of the head if asked for, until the stage ends."""
        steps = {"counted": state.schedule_step - self.taken_back, "taken_back": self.taken_back}
        running = {"pruning": dict(state.pruning), "restarts": restarts(state.schedulers)}
        self.kept[name] = {**steps, **running, **state.snapshot(head=head)}

    def go_back(self, name: str, state: TrainingState) -> None:
        """Continue with a kept copy, its learning rates and its counted steps."""
        kept, peak = self.kept[name], state.pruning["peak"]  # of all trials
        state.restore(kept)
        state.pruning.update({**kept["pruning"], "peak": peak})
        self.taken_back = state.schedule_step - kept["counted"]
        put_restarts(state.schedulers, kept["restarts"], self.taken_back - kept["taken_back"])

    def end(self, run: TrainingRun, stage: str) -> None:
        """End the trials of a stage: forget the kept copies, and serve its views from the next step on."""
        self.trial = None
        self.kept = {}
        self._mean = RunningMean()
        self.coming.pop(stage, None)
        self.hold_out(run)
        self._apply(run.state)

    def measure(self, run: TrainingRun) -> list[HeldOutQuality]:
        """Quality of the held-out views with the mean of the weights, if there is one."""
        with self._mean.applied(weights_of(run.state)):
            return measure_held_out(run, with_fitted=self.progress.stage == "count")

    def _go_on(self, run: TrainingRun) -> None:
        """Once the current trial has ended, measure it; try the next candidate of the stage, or choose."""
        progress, state, stage = self.progress, run.state, self.progress.stage
        if not self.advance(run):
            return
        if stage == "repeat":
            self._mean.replace(weights_of(state))  # the mean of the last window stays to the end of the schedule
            state.restored += 1  # another mean must not contain the weights before it
            self._end_length(run, "paused", progress.chosen["length"])
            _log.info(f"step {state.step}: more training would harm other views; the remaining steps change nothing")
            return
        assert self.trial is not None
        enabled = state.head if state.head_enabled else None
        width = 0 if enabled is None else enabled.config.num_features
        head = next(head for head in self._heads if self._widths[head] == width)
        row = Tried(stage, run.source.total, head, self.trial.length, [list(view) for view in self.measure(run)])
        progress.tried.append(row)
        if stage in COUNTS:
            row.bytes = packed_size(state.gaussians, enabled)
            self.go_back("start", state)
            self._try_count(run)
        elif stage == "head":
            params = {name: value for name, value in state.gaussians.items() if enabled is not None or name != FEATURES}
            size = stored_bytes(params, None)
            row.bytes = [size, stored_bytes(params, enabled and enabled.config) - size]
            self._try_head(run, head)
        else:
            self._try_length(run)

    def _announce(self, run: TrainingRun, question: str, trials: int, length: int, views: list[int]) -> None:
        held_out = f"{len(views)} of {len(run.view_indices())} training views are held out"
        _log.info(f"step {run.state.step}: {question} Up to {trials} trials of {length:,} steps; {held_out}")

    def curve(self) -> list[CurvePoint]:
        """Expected quality over the counts that were tried, largest first, with a head if trials say that it pays."""
        curve, tenth = choice.curve_of(self.progress.of("count")), self.progress.of("tenth")
        return choice.with_head(curve, HeadGain.of(*tenth)) if self.progress.chosen.get("tenth") else curve

    def _begin_counts(self, run: TrainingRun) -> None:
        state = run.state
        state.pruner.drop_nonfinite()
        self._densification.initialize(state)  # its statistics would not match the Gaussians that come back
        self.progress.full = run.source.total
        self._announce(run, "how many Gaussians does the scene need?", len(SHARES), self._window, self._judges)
        self.keep("start", state, head=self.decides_head and state.head is not None)
        self._try_count(run)

    def _try_count(self, run: TrainingRun) -> None:
        """Try the next count or, on the usual share, no head and then a head; or choose."""
        progress, state = self.progress, run.state
        number = len(progress.of("count"))
        tenth, curve = progress.of("tenth"), self.curve()
        if len(tenth) == 2:
            progress.chosen["tenth"] = choice.head_pays(curve, HeadGain.of(*tenth), self._tolerance)
            curve = self.curve()
        usual = kept_count(USUAL_SHARE, progress.full)
        # The count within a limit of bytes depends on those of the head.
        tries_head = self.decides_head and state.head is not None
        promising = number == 0 or (curve and not choice.is_lost(curve[-1], self._tolerance))
        if progress.stage != "tenth" and number < len(SHARES) and promising:
            count = kept_count(SHARES[number], progress.full)
            self._prune(run, count)
            notify_pruned(state.schedulers, state.step, count, last=False, ends_at=state.step + self._window)
            self.start(run, "count", self._window, self._judges, width=0)
        elif tries_head and curve and len(tenth) < 2 and (self.config.max_bytes or self._count_of(curve)[0] > usual):
            self._prune(run, usual)
            limit_rise(state.schedulers, round(RISE_SHARE * self._length))
            notify_pruned(state.schedulers, state.step, usual, last=False)
            # On the views that it would hold out for trials of its own.
            self.start(run, "tenth", self._length, sum(self._folds, []), self._widths["head" if tenth else "plain"])
        else:
            self._choose_count(run, curve)

    def _prune(self, run: TrainingRun, count: int) -> None:
        """Prune as the schedule would, by fewer views."""
        state, contribute = run.state, partial(run.contribution, most=MOST_CONTRIBUTING)
        prune_to(lambda n: min(count, n), self.config, state.pruner, state.pruning, state.schedule_step, contribute)

    def _count_of(self, curve: list[CurvePoint]) -> tuple[int, str]:
        limits = {"most": self.config.max_gaussians, "most_bytes": self.config.max_bytes}
        return choice.choose_within(curve, self._tolerance, **limits)

    def _choose_count(self, run: TrainingRun, curve: list[CurvePoint]) -> None:
        """Choose a count, and let the schedule prune to it."""
        progress = self.progress
        if not curve:
            self._keep_usual(run, _MASKED)
            return
        count, reason = self._count_of(curve)
        self._set_count(run, count)
        _log.info("\n".join(["expected at the end, on held-out training views:", *curve_table(curve)]))
        _log.info(f"keeping {count:,} of {progress.full:,} Gaussians: {reason}")
        run.log_scalars("Curve", {"chosen": count, "full": progress.full})
        record: dict[str, Any] = {"chosen": count, "full": progress.full, "reason": reason, "step": run.state.step}
        record |= {"tolerance": self._tolerance._asdict(), "held_out_views": self._judges}
        measured = [[view._asdict() for view in row.qualities] for row in progress.of("count")]
        points = [{**asdict(point), "measured": views} for point, views in zip(curve, measured, strict=True)]
        record |= {"steps_per_trial": self._window, "curve": points}
        if "tenth" in progress.chosen:
            figures = _figures(progress.of("tenth"))
            _log.info(f"a tenth of the Gaussians after {self._length:,} steps: {_in_words(figures)}")
            record["head"] = {"pays": progress.chosen["tenth"], "steps_per_trial": self._length, **figures}
        self._record(run, count=record)

    def _keep_usual(self, run: TrainingRun, reason: str) -> None:
        kept = f"pruning keeps {usual_share(run.state.pruning[VIEWS]):.0%} of the Gaussians"
        _log.warning(f"{kept}: {reason}; --pipeline.model.pruning.keep-ratio sets it")
        self._set_count(run, 0)

    def _set_count(self, run: TrainingRun, count: int) -> None:
        """End the trials of counts; with 0 the schedule keeps the usual share."""
        self.progress.stage = ""
        self.progress.chosen["count"] = run.state.pruning[COUNT] = count
        self.end(run, "count")
        self.enable_head(run.state, not self.decides_head)

    def _heads_fit(self, run: TrainingRun) -> bool:
        """Whether the chosen candidate can train on for the length of a trial."""
        trials = len(self._heads) * len(self._folds) + 1
        return _steps_of(run) + run.state.offset > self.begins_at + trials * self._length

    def _begin_heads(self, run: TrainingRun) -> None:
        if "tenth" in self.progress.chosen:
            head = "head" if self.progress.chosen["tenth"] else "plain"
            self._finish_with(run, head, "the trials of counts have shown what it gains")
            return
        trials = len(self._heads) * len(self._folds)
        self._announce(run, "is the head worth it?", trials, self._length, sum(self._folds, []))
        limit_rise(run.state.schedulers, round(RISE_SHARE * self._length))
        self.keep("start", run.state, head=True)
        self._start_head(run)

    def _start_head(self, run: TrainingRun) -> None:
        number, fold = divmod(len(self.progress.of("head")), len(self._folds))
        self.start(run, "head", self._length, self._folds[fold], self._widths[self._heads[number]])

    def _try_head(self, run: TrainingRun, head: str) -> None:
        """Try the next head from the same Gaussians, unless the last one does not pay; or choose."""
        tried, folds = self.progress.of("head"), len(self._folds)
        complete = len(tried) % folds == 0 and head != "plain"
        if complete and (head == self._heads[-1] or choice.best_head(tried, folds) != head):
            self._choose_head(run, head)
            return
        self.keep(head, run.state, head=head != "plain")
        self.go_back("start", run.state)
        self._start_head(run)

    def _choose_head(self, run: TrainingRun, trained: str) -> None:
        """Continue with the best candidate; ``trained`` is the last one."""
        tried = self.progress.of("head")
        head, figures = choice.best_head(tried, len(self._folds)), _figures(tried)
        reason = "" if all(row.views for row in tried) else _MASKED
        record: dict[str, Any] = {}
        if not reason:
            _log.info(f"step {run.state.step}: held-out training views: {_in_words(figures)}. Chosen: {NAMES[head]}")
            run.log_scalars("Trials", {f"psnr_{name}": figure["psnr"] for name, figure in figures.items()})
            record = {"held_out_views": sum(self._folds, []), "steps_per_trial": self._length, "arms": figures}
        if head != trained:
            self.go_back(head, run.state)
        self._finish_with(run, head, reason, record)

    def _finish_with(self, run: TrainingRun, head: str, reason: str, record: Mapping[str, Any] | None = None) -> None:
        """Take a decision about the head, serve all training views from now on, and record it."""
        progress, state = self.progress, run.state
        if reason:
            _log.info(f"the head is {'removed' if head == 'plain' else 'enabled'}: {reason}")
        progress.chosen["head"] = head
        progress.stage, progress.reason = "", reason
        self.end(run, "head")
        self.enable_head(state, head != "plain")
        if head == "plain":
            state.remove_head()
        self._record(run, head={"decision": head, "reason": reason, "step": state.step, **(record or {})})

    def _begin_length(self, run: TrainingRun) -> None:
        progress, state = self.progress, run.state
        # The chosen candidate has not seen these since before its trial.
        views = [] if progress.reason else self._folds[-1]
        watched = int(WATCHED_SHARE * (progress.steps - state.schedule_step))
        num_views = len(run.view_indices())
        # A warm start has learnt all views: what it forgets of them is no overfitting.
        if state.offset > 0 or not views or num_views >= MANY_VIEWS or watched < self._window:
            progress.chosen["length"] = None
            return
        progress.watched_until = state.schedule_step + watched
        self.keep("start", state, head=state.head_enabled)
        self.start(run, "length", self._window, views)
        held = f"{num_views} training views are few; {len(views)} stay held out"
        _log.info(f"step {state.step}: {held}, to see when training stops helping")

    def _try_length(self, run: TrainingRun) -> None:
        """Train another window; or go back, to train on all views for as many steps as were best."""
        progress, state = self.progress, run.state
        views = self._folds[-1]
        measured = []
        for row in progress.of("length"):
            psnr, ssim = mean_quality(row.qualities)
            measured.append({"loss": choice.loss_of(row.qualities, self.ssim_weight), "psnr": psnr, "ssim": ssim})
        run.log_scalars("Stopping", {name: measured[-1][name] for name in ("psnr", "ssim")})
        best, lost = choice.best_length([window["loss"] for window in measured])
        length = best * self._window if lost else None
        if length is not None:
            then, now = (f"{row['psnr']:.2f} dB, SSIM {row['ssim']:.4f}" for row in (measured[best - 1], measured[-1]))
            best_at = f"the held-out views were best after {length:,} steps, {then}; now {now}"
            _log.info(f"step {state.step}: {best_at}. Going back, to train as long on all views")
            self.go_back("start", state)
            self._end_length(run, "repeat", length)
            self.start(run, "repeat", length, [])
        elif state.schedule_step + self._window > progress.watched_until:
            _log.info(f"step {state.step}: the held-out views lose nothing; training continues on all views")
            self._end_length(run, "", None)
        else:
            self.start(run, "length", self._window, views)
            return
        record = {"held_out_views": views, "steps_per_measurement": self._window, "measured": measured}
        self._record(run, length={**record, "steps_on_all_views": length, "step": state.step})

    def _end_length(self, run: TrainingRun, stage: str, length: int | None) -> None:
        self.progress.stage, self.progress.chosen["length"] = stage, length
        self.end(run, "length")

    def _record(self, run: TrainingRun, **decided: Mapping[str, Any]) -> None:
        """Write ``trials.json`` with the records of all decisions."""
        self.progress.records |= decided
        if self.progress.records:
            write_record(run, RECORD, self.progress.records)


class AfterPrune(Callback):
    """Calls trials again after the schedule's prune, because callbacks act in their order."""

    name = "after-prune"

    def __init__(self, trials: Trials) -> None:
        self._trials = trials

    def after_step(self, run: TrainingRun) -> None:
        """Try heads and lengths."""
        self._trials.after_prune(run)


def _steps_of(run: TrainingRun) -> int:
    """Steps of the whole schedule, at least those of this training; 0 if unknown."""
    return 0 if run.last_step is None else max(run.last_step + 1, run.schedule_length or 0)


def _figures(tried: list[Tried]) -> dict[str, dict[str, Any]]:
    """Mean figures by head, over all folds, for a record."""
    figures = {}
    for head in dict.fromkeys(row.head for row in tried):
        rows = [row for row in tried if row.head == head]
        views = [view for row in rows for view in row.qualities]
        psnr, ssim = mean_quality(views)
        size = sum(rows[0].bytes) if rows[0].bytes else None
        figures[head] = {"psnr": psnr, "ssim": ssim, "bytes": size, "views": [view._asdict() for view in views]}
    return figures


def _in_words(figures: Mapping[str, Mapping[str, Any]]) -> str:
    return "; ".join(
        f"{NAMES[name]} {figure['psnr']:.2f} dB, SSIM {figure['ssim']:.4f}"
        + ("" if figure["bytes"] is None else f", {figure['bytes'] / 1e6:.2f} MB")
        for name, figure in figures.items()
    )
