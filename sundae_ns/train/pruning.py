"""Pruning in training: its options, the callbacks that prune and remove floaters, and their records.

The running state is a dict of integers, which checkpoints carry: a resumed run neither prunes twice nor forgets its
peak.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from sundae_ns.core.errors import ConfigError, SundaeError
from sundae_ns.core.files import write_text
from sundae_ns.core.share import Share
from sundae_ns.core.tables import without_nan
from sundae_ns.core.timing import now, peak_memory
from sundae_ns.io.run_folder import PRUNES, prunes_before
from sundae_ns.pruning.decision import Pruner
from sundae_ns.pruning.floaters import MOST_FLOATERS, near_cameras
from sundae_ns.pruning.rule import PruneRule, ScoreName, kept_count
from sundae_ns.train.schedules import notify_pruned
from sundae_ns.train.state import Callback, TrainingRun, TrainingState

_log = logging.getLogger(__name__)

USUAL_SHARE = 0.1  # Share of the Gaussians that a prune keeps by default
MANY_VIEWS = 32  # With as many, counts are tried, and no length is: captures of 43 training views gain to the end
USUAL_VIEWS = 16  # Up to as many keep the usual share of the Gaussians, others below MANY_VIEWS more in proportion
DROPPED, FEW_DROPPED = 0.1, 0.2  # Share of the Gaussians that a step after the prune leaves out; with few views
NEVER = -1  # Value of state["pruned_at"] before the first prune
UNPRUNED = {"pruned_at": NEVER, "num_prunes": 0, "peak": 0}  # Running state at the start; the peak is of Gaussians
COUNT, VIEWS = "count", "views"
"""Keys of the running state: the number that trials have chosen, 0 where they cannot, and of training views."""
PACKED_BYTES = 21  # Of a Gaussian without features, where no trial measures them: 20 to 22 on six captures
LEAST_OPACITY = 0.005  # Of Gaussians that share the appearance of one; 3DGS-MCMC counts lower ones as dead

Running = MutableMapping[str, Any]
Contribute = Callable[[int | None], Tensor]
"""Renders the training views and returns the contribution of the pruner's Gaussians ``[N]``; the argument is ``count``
of :func:`sundae_ns.scene.render.contribution`."""


@dataclass
class PruningConfig(PruneRule):
    """When to prune and how many Gaussians to keep, beside the rule that says which."""

    selection: Literal["systematic", "pairs", "band"] = "systematic"
    """How scores select Gaussians: by draws in space (systematic), by least different pairs, or by the paper (band)."""
    score: ScoreName = "detail-contribution"
    """Importance of a Gaussian: its blending weight over the training views, with pixels weighted by the detail that
    the kept Gaussians cannot show (detail-contribution), or its high-pass response (response)."""
    mode: Literal["one-shot", "continuous", "off"] = "one-shot"
    """Prune once (one-shot, the paper's main strategy), periodically during densification for less peak memory
    (continuous), or never (off)."""
    keep_ratio: Share | None = USUAL_SHARE
    """Share of the N Gaussians that one prune keeps, in (0, 1] or as 25%: round(keep_ratio * N). One-shot: None lets
    trials on held-out training views decide the number."""
    prune_at: int = 12000  # Step after which the one-shot prune happens
    start: int = 2000  # First step of continuous pruning
    stop: int = 15000  # Last step of continuous pruning
    every: int = 2000  # Steps from one continuous prune to the next
    max_gaussians: int | None = None
    """Most Gaussians that a one-shot prune keeps, or that there are in continuous pruning, densification included."""
    target_gaussians: int | None = None
    """Exactly how many each prune keeps, and how many continuous pruning ends with: Gaussians are added if need be."""
    max_drop: float | None = None
    """One-shot, where trials decide: PSNR in dB that a smaller field may lose against the best one, and SSIM in
    proportion. None for 0.1 dB and 0.003."""
    max_bytes: int | None = None  # One-shot, where trials decide: most bytes of the packed scene, by an estimate

    @property
    def decides(self) -> bool:
        """Whether trials decide how many Gaussians the one-shot prune keeps."""
        return self.mode == "one-shot" and self.keep_ratio is None and self.target_gaussians is None

    @property
    def cap(self) -> int | None:
        """Most Gaussians of a field that grows; None for no cap."""
        return self.max_gaussians if self.mode == "continuous" else None

    def growth_ends_at(self, stop_split_at: int) -> int:
        """Step at which densification ends: ``stop_split_at``, or an earlier prune, which undoes later growth."""
        return min(stop_split_at, {"one-shot": self.prune_at, "continuous": self.stop}.get(self.mode, stop_split_at))

    @property
    def last_due(self) -> int:
        """Step of the last scheduled prune; later ones happen only if the field exceeds a target or a cap."""
        if self.mode != "continuous":
            return self.prune_at
        if self.target_gaussians is not None or self.max_gaussians is not None:
            return self.stop
        return self.start + (self.stop - self.start) // self.every * self.every

    @property
    def settled_at(self) -> int:
        """Step after which the number of Gaussians does not change."""
        return self.stop if self.mode == "continuous" else self.prune_at

    def due(self, state: Mapping[str, Any], step: int, n: int) -> bool:
        """Whether a field of ``n`` Gaussians is to be pruned after this step.

        One-shot: after ``prune_at``, or at once if training was resumed from a later step without a prune. Continuous:
        at ``start`` and every ``every`` steps until ``stop``; with a target only if there are more Gaussians. From
        ``stop`` on at every step with more Gaussians than the target or, without a target, the cap.
        """
        if self.mode == "one-shot":
            return (not self.decides or COUNT in state) and state["pruned_at"] == NEVER and step >= self.prune_at
        if self.mode != "continuous":
            return False
        scheduled = self.start <= step <= self.stop and (step - self.start) % self.every == 0
        most = self.max_gaussians if self.target_gaussians is None else self.target_gaussians
        by_count = most is not None and n > most and (scheduled or step >= self.stop)
        return ((scheduled and self.target_gaussians is None) or by_count) and step > state["pruned_at"]

    def target(self, n: int, state: Mapping[str, Any]) -> int:
        """Number of Gaussians that a prune keeps of ``n`` finite ones; at least 1, and under the cap."""
        if self.target_gaussians is not None:
            return min(self.target_gaussians, n)
        chosen = state.get(COUNT, 0) if self.decides else 0
        share = usual_share(state.get(VIEWS, MANY_VIEWS)) if self.keep_ratio is None else self.keep_ratio
        fitting = self.max_bytes // PACKED_BYTES if self.max_bytes and not chosen else n
        return max(min(chosen or kept_count(share, n), self.max_gaussians or n, fitting, n), 1)

    def validate(self) -> None:
        """Check every option; raises a ConfigError with the first that is invalid and its remedy."""
        super().validate()
        if self.keep_ratio is not None:
            kept_count(self.keep_ratio, 1)  # raises if the share is invalid
        self.check_at_least(every=1, prune_at=0, start=0, max_gaussians=1, target_gaussians=1, max_bytes=1)
        cap, target, drop = self.max_gaussians, self.target_gaussians, self.max_drop
        continuous, no_count = self.mode == "continuous", self.keep_ratio is None and target is None
        over = cap is not None and target is not None and target > cap
        tried = "is set, and trials do not decide the number of Gaussians: set keep_ratio to None and mode to one-shot"
        refusals = [
            (continuous and self.stop < self.start, f"start ({self.start}) lies after stop ({self.stop}): swap them"),
            (continuous and no_count, "keep_ratio is None and mode is continuous: give 0.5, or target_gaussians"),
            (self.mode == "off" and (cap or target), "mode is off and prunes nothing: set one-shot, or drop the count"),
            (drop is not None and not self.decides, f"max_drop {tried}, as sundae does"),
            (self.max_bytes is not None and not self.decides, f"max_bytes {tried}, as sundae does"),
            (drop is not None and not 0 < drop < math.inf, f"max_drop is {drop}: give 0.1, or another number of dB"),
            (over, f"target_gaussians ({target}) is more than max_gaussians ({cap}): swap them"),
        ]
        for refused, message in refusals:
            if refused:
                raise ConfigError(message)


def usual_share(num_views: int) -> float:
    """Share of the Gaussians that a prune keeps where trials cannot decide."""
    return USUAL_SHARE * (max(num_views / USUAL_VIEWS, 1) if num_views < MANY_VIEWS else 1)


def write_record(run: TrainingRun, name: str, record: Any) -> None:
    """Write a record as JSON to the run's folder, if there is one; numbers that are not finite become null."""
    if run.folder is not None:
        write_text(run.folder / name, json.dumps(without_nan(record), indent=2, allow_nan=False) + "\n")


def prune_when_due(
    config: PruningConfig, pruner: Pruner, state: Running, step: int, contribute: Contribute
) -> dict[str, Any] | None:
    """Prune if it is due; add Gaussians that lack to the target. Call it after optimizers and densification.

    Arguments and errors are those of :func:`prune_to`, and so is the report; None if no prune was due.
    """
    report = None
    state["peak"] = max(state["peak"], pruner.total)
    if config.due(state, step, pruner.total):
        # Continuous pruning draws anew each time, and the same after a resume.
        rule = replace(config, seed=config.seed + step) if config.mode == "continuous" else config
        report = prune_to(lambda n: config.target(n, state), rule, pruner, state, step, contribute)
    lacking = (config.target_gaussians or 0) - pruner.total
    if config.mode == "continuous" and step >= config.stop and lacking > 0:
        pruner.add(lacking, LEAST_OPACITY)
        state["peak"] = max(state["peak"], pruner.total)
    return report


def prune_to(
    target: Callable[[int], int], rule: PruneRule, pruner: Pruner, state: Running, step: int, contribute: Contribute
) -> dict[str, Any]:
    """Prune in training: drop what is not finite, decide the count, render, cut, and record the ``step`` that ended.

    ``target`` maps the number of finite Gaussians to the number to keep; ``state`` is :data:`UNPRUNED`, or from a
    checkpoint; ``contribute`` is called only if the rule needs it, after Gaussians that are not finite have been
    removed. Returns ``step``; numbers of Gaussians: ``before`` (with those that are not finite), ``after``,
    ``dropped_nonfinite``, and the ``peak`` of all steps; ``seconds``, synchronised; and of the graph, None without one:
    ``tau``, the threshold on squared distances, ``sigma``, the width of the edge weights, and the number of
    ``isolated``. ``DataError`` as :func:`sundae_ns.pruning.decision.decide`.
    """
    device = pruner.params["means"].device
    before, started = pruner.total, now(device)
    dropped = pruner.drop_nonfinite()
    count = target(pruner.total)
    needs_views = rule.uses_contribution and count < pruner.total
    weights = contribute(count if rule.uses_detail else None) if needs_views else None
    decision = pruner.cut(rule, count, weights)
    state.update(pruned_at=step, num_prunes=state["num_prunes"] + 1)
    report: dict[str, Any] = {"step": step, "before": before, "after": decision.kept, "dropped_nonfinite": dropped}
    report |= {"peak": state["peak"], "seconds": now(device) - started}
    return {**report, "tau": decision.tau, "sigma": decision.sigma, "isolated": decision.isolated}


def summary(report: Mapping[str, Any]) -> str:
    """The report of a prune as one line for the log."""
    line = "step {step}: kept {after:,} of {before:,} Gaussians in {seconds:.1f} s; peak {peak:,}".format(**report)
    if report["sigma"] is not None:
        line += "; sigma {sigma:.3g}, tau {tau:.3g}, {isolated:,} isolated".format(**report)
    return line


class ScheduledPruning(Callback):
    """Prunes when it is due; ``evaluate`` measures all test views on both sides of the one-shot prune."""

    name = "pruning"

    def __init__(self, config: PruningConfig, *, evaluate: bool) -> None:
        self.config = config
        self.evaluate = evaluate and config.mode == "one-shot"

    def before_training(self, run: TrainingRun) -> None:
        """Warn if training ends before the prune or the head."""
        if run.last_step is not None:
            _warn_if_too_short(run, self.config, run.last_step)

    def needs_all(self, run: TrainingRun) -> bool:
        """Whether a prune is due."""
        return self.config.due(run.state.pruning, run.state.schedule_step, run.source.total)

    def after_step(self, run: TrainingRun) -> None:
        """Prune if it is due, evaluate, report, and restart the learning rates; saves before a ``SundaeError``."""
        state, config = run.state, self.config
        due = self.needs_all(run)
        # Densification has the most Gaussians after growing, before it culls.
        state.pruning["peak"] = max(state.pruning["peak"], state.densification.get("peak", 0))
        if due:
            _log.info(f"step {state.step}: pruning {run.source.total:,} Gaussians, with passes over the training views")
        before = run.evaluate() if due and self.evaluate else {}
        try:
            report = prune_when_due(config, state.pruner, state.pruning, state.schedule_step, run.contribution)
        except SundaeError:
            # Do not lose the warm-up to an option that can be corrected: a resumed run prunes at its first step.
            run.save()
            raise
        if state.schedule_step >= config.settled_at:
            with_head = state.schedule_step >= state.head_starts_at
            notify_pruned(state.schedulers, state.step, run.source.total, last=with_head)
        if report is None:
            return
        _log.info(summary({**report, "step": state.step}))  # that of the schedule is another after a warm start
        if report["dropped_nonfinite"]:
            _log.warning(f"removed {report['dropped_nonfinite']} Gaussians that were not finite")
        if report["after"] < (config.target_gaussians or 0):
            _log.warning(f"the field has only {report['after']:,} Gaussians; a lower densify-grad-thresh grows more")
        after = run.evaluate() if due and self.evaluate else {}
        for label, results in (("warm-up", before), ("pruned", after)):
            if results:
                _log.info("{}: PSNR {psnr:.2f} dB, SSIM {ssim:.4f} on all test views".format(label, **results))
        run.log_scalars("Prune", {name: report[name] for name in ("before", "after", "seconds", "peak")})
        if run.folder is not None:
            # A run that was killed between a prune and the next save repeats that prune.
            earlier = prunes_before(run.folder / PRUNES, report["step"])
            write_record(run, PRUNES, [*earlier, {**report, "warm_up": before, "pruned": after}])

    def finish(self, run: TrainingRun) -> None:
        """Report the peak, and warn if nothing was pruned."""
        state = run.state
        peak, memory = state.pruning["peak"], peak_memory(state.device) / 1e6
        _log.info(f"peak: {peak:,} Gaussians, {memory:,.0f} MB of {state.device.type} memory")
        run.log_scalars("Peak", {"gaussians": peak, "memory_mb": memory})
        _warn_if_too_short(run, self.config, state.step)


def _warn_if_too_short(run: TrainingRun, pruning: PruningConfig, last_step: int) -> None:
    """Warn if a training that ends with this step does not reach its first prune, its last prune, or its head."""
    state, target, starts_at = run.state, pruning.target_gaussians, run.state.head_starts_at
    continuous, pruned = pruning.mode == "continuous", state.pruning["num_prunes"] > 0
    begins, ends, first = ("start", "stop", pruning.start) if continuous else ("prune-at", "prune-at", pruning.prune_at)
    prunes = pruning.mode != "off" and state.offset == 0  # a warm start is pruned at once
    # A head whose start is not known yet is decided upon elsewhere.
    idle = state.head is not None and math.isfinite(starts_at) and last_step + state.offset <= starts_at
    reached = pruned and target is not None and run.source.total <= target
    and_head = ", and the head stays disabled" if idle else ""
    head_at = int(starts_at) + 1 - state.offset if idle else 0  # the head is enabled in the steps after that one
    head_option = "head.start-at" if starts_at != pruning.settled_at else f"pruning.{ends}"
    few, many = f"nothing is pruned{and_head}", f"more Gaussians are left than asked for{and_head}"
    unfinished = prunes and last_step < pruning.last_due and not reached
    rows = [
        (prunes and last_step < first and not pruned, "first prune", first, f"pruning.{begins}", few),
        (unfinished, "last prune", pruning.last_due, f"pruning.{ends}", many),
        (idle, "head", head_at, head_option, "it stays disabled"),
    ]
    for missed, event, step, option, result in rows:
        if missed:
            _log.warning(
                f"training ends after {last_step + 1:,} steps, and the {event} needs more than {step:,} ({option}): "
                f"{result}; train longer, or {'enable it' if option.startswith('head') else 'prune'} earlier"
            )
            return


class FloaterRemoval(Callback):
    """Removes what floats in front of a camera before anything is pruned, and before counts are compared.

    Afterwards no Gaussian is added, so what they showed is learnt by those that stay. Without sparse points of the
    capture ``[P, 3]`` nothing is removed.
    """

    name = "floaters"

    def __init__(self, points: Tensor | None) -> None:
        self._points = points  # None once floaters were removed

    def state_dict(self) -> dict[str, Any]:
        """Whether floaters were removed."""
        return {"done": self._points is None}

    def load_state_dict(self, state: TrainingState, saved: Mapping[str, Any]) -> None:
        """Counterpart of :meth:`state_dict`; without points there is nothing to do."""
        self._points = None if saved.get("done") else self._points

    def needs_all(self, run: TrainingRun) -> bool:
        """Whether this is the last step at which the field grows, so that a saved warm-up has no floaters."""
        return self._points is not None and run.state.schedule_step + 1 >= run.state.densify_until

    def after_step(self, run: TrainingRun) -> None:
        """Remove floaters once."""
        state = run.state
        if (points := self._points) is None or not self.needs_all(run):
            return
        self._points = None
        eyes = torch.stack([camera.center for camera, _ in run.training_views()])
        if removed := state.pruner.drop(near_cameras(state.gaussians["means"], eyes, points), at_most=MOST_FLOATERS):
            _log.info(f"step {state.step}: removed {removed:,} floaters right in front of a camera")
