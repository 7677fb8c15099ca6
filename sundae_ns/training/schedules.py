"""Pruning schedules: when a field is pruned, and to how many primitives.

A schedule decides, :func:`sundae_ns.pruning.cutting.cut` prunes. Its verbs, ``initialize_state`` and
``step_post_backward``, are those of gsplat's densification strategies. The running state is a dict of integers, so that a
checkpoint can carry it: a resumed run neither prunes twice nor forgets its peak.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from sundae_ns.gaussians.parameters import num_primitives
from sundae_ns.gaussians.relocation import grow
from sundae_ns.gaussians.surgery import per_primitive
from sundae_ns.pruning.config import PruningConfig
from sundae_ns.pruning.cutting import cut
from sundae_ns.pruning.scores import Contribution
from sundae_ns.pruning.selection import kept_count
from sundae_ns.training.report import PruneReport

NEVER = -1
"""Value of ``state["pruned_at"]`` before the first prune."""
LEAST_OPACITY = 0.005
"""Lowest opacity of primitives that share the appearance of one; 3DGS-MCMC counts lower ones as dead."""


@dataclass(frozen=True)
class PruningSchedule:
    """Base of the schedules: running state, peak and report. Subclasses say when a prune is due, and how many it keeps."""

    config: PruningConfig
    """Options; not changed."""

    def due(self, state: Mapping[str, Any], step: int, n: int) -> bool:
        """Whether a field of ``n`` primitives is to be pruned after this step."""
        raise NotImplementedError

    def target(self, n: int) -> int:
        """Number of primitives that a prune keeps of ``n`` finite ones. The one place that decides this number."""
        raise NotImplementedError

    def initialize_state(self) -> dict[str, Any]:
        """Running state: step of the last prune (-1 for none), number of prunes, peak number of primitives."""
        return {"pruned_at": NEVER, "num_prunes": 0, "peak": 0}

    @torch.no_grad()
    def step_post_backward(
        self,
        params: MutableMapping[str, Parameter],
        optimizers: Mapping[str, Optimizer],
        state: MutableMapping[str, Any],
        step: int,
        info: Mapping[str, Any] | None = None,
        *,
        contribution: Contribution | None = None,
        strategy_state: MutableMapping[str, Any] | None = None,
    ) -> PruneReport | None:
        """Prune if it is due. Call it after the optimizer's step and after densification.

        Args:
            params: the field; its parameters are replaced when it is pruned.
            optimizers: optimizers by parameter name; others are left alone.
            state: from :meth:`initialize_state`, or from a checkpoint.
            step: training step that has just ended.
            info: part of the common signature, not read.
            contribution: gives the blending weights over the training views ``[N]``. It is called only if the score needs
                it, after primitives that are not finite have been removed.
            strategy_state: state of a densification strategy on the same primitives; sliced with them.

        Returns:
            A report, or None if no prune was due.

        Raises:
            ConfigError: the score needs a contribution and there is none.
            DataError: the field cannot be pruned, see :func:`sundae_ns.pruning.decide`.
        """
        before = num_primitives(params)
        state["peak"] = max(state["peak"], before)
        if not self.due(state, step, before):
            return None
        started = _now(params)
        decision = cut(
            params,
            optimizers,
            state,
            self._config_at(step),
            contribution,
            step=step,
            count=self.target,
            strategy_state=strategy_state,
        )
        return PruneReport(
            step=step,
            before=before,
            after=decision.kept,
            dropped_nonfinite=decision.dropped_nonfinite,
            peak=state["peak"],
            seconds=_now(params) - started,
            tau=decision.tau,
            sigma=decision.sigma,
            isolated=decision.isolated,
        )

    def _config_at(self, step: int) -> PruningConfig:
        """Options of the prune at a step."""
        return self.config


class NoPruning(PruningSchedule):
    """Never prunes; the running state still records the peak."""

    def due(self, state: Mapping[str, Any], step: int, n: int) -> bool:
        """Never."""
        return False

    def target(self, n: int) -> int:
        """All of them."""
        return n


class OneShotPruning(PruningSchedule):
    """Training, one prune that keeps ``keep_ratio``, then fine-tuning: the paper's main strategy."""

    def due(self, state: Mapping[str, Any], step: int, n: int) -> bool:
        """After ``prune_at``, or at once if training was resumed from a later step without a prune."""
        return state["pruned_at"] == NEVER and step >= self.config.prune_at

    def target(self, n: int) -> int:
        """``round(keep_ratio * n)``, at least 1."""
        return kept_count(self.config.keep_ratio, n)


class ContinuousPruning(PruningSchedule):
    """Periodic pruning during densification, for a lower peak of memory.

    The paper's alternative (section "Continuous Pruning as a Strategy"): each prune keeps ``keep_ratio``, so that the final
    number is only roughly known. With ``target_primitives`` each prune goes down to exactly that number; the last one comes
    after densification, so this is the final number. ``max_primitives`` is a cap on every prune, and on every step in
    between through :class:`sundae_ns.training.densification.CappedStrategy`.
    """

    def due(self, state: Mapping[str, Any], step: int, n: int) -> bool:
        """At ``start`` and every ``every`` steps until ``stop``; with a target only if there are more primitives.

        From ``stop`` on at every step with more primitives than the target or, without a target, the cap.
        """
        config, target = self.config, self.config.target_primitives
        scheduled = config.start <= step <= config.stop and (step - config.start) % config.every == 0
        most = config.max_primitives if target is None else target
        above = most is not None and n > most
        by_share = scheduled and target is None
        by_count = above and (scheduled or step >= config.stop)
        return (by_share or by_count) and step > state["pruned_at"]

    def _config_at(self, step: int) -> PruningConfig:
        # A new draw at each prune, and the same one after a resume.
        return replace(self.config, seed=self.config.seed + step)

    @torch.no_grad()
    def step_post_backward(
        self,
        params: MutableMapping[str, Parameter],
        optimizers: Mapping[str, Optimizer],
        state: MutableMapping[str, Any],
        step: int,
        info: Mapping[str, Any] | None = None,
        *,
        contribution: Contribution | None = None,
        strategy_state: MutableMapping[str, Any] | None = None,
    ) -> PruneReport | None:
        """Prune if it is due. If densification has ended with fewer than ``target_primitives``, add the missing ones.

        They are added on top of others and share their opacity, so that no image changes. Per-primitive statistics of
        densification are dropped then, because it has ended.
        """
        report = super().step_post_backward(
            params, optimizers, state, step, info, contribution=contribution, strategy_state=strategy_state
        )
        n = num_primitives(params)
        lacking = (self.config.target_primitives or 0) - n
        if step >= self.config.stop and lacking > 0:
            grow(params, optimizers, lacking, LEAST_OPACITY)
            if strategy_state is not None:
                stale = [k for k, v in strategy_state.items() if per_primitive(v, n)]
                strategy_state.update(dict.fromkeys(stale))
            state["peak"] = max(state["peak"], n + lacking)
        return report

    def target(self, n: int) -> int:
        """``target_primitives``, or the keep ratio's share under the cap."""
        config = self.config
        if config.target_primitives is not None:
            return min(config.target_primitives, n)
        count = kept_count(config.keep_ratio, n)
        return count if config.max_primitives is None else min(count, config.max_primitives)


def make_schedule(config: PruningConfig) -> PruningSchedule:
    """Schedule of the configured mode.

    Raises:
        ConfigError: an option cannot work.
    """
    config.validate()
    # In auto mode the budget search prunes; the schedule only records the peak.
    schedules = {"off": NoPruning, "auto": NoPruning, "one-shot": OneShotPruning, "continuous": ContinuousPruning}
    return schedules[config.mode](config)


def _now(params: Mapping[str, Tensor]) -> float:
    """Wall-clock seconds after all queued work on the field's device."""
    device = params["means"].device
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
