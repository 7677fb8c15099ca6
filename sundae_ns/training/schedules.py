"""When to prune: policies of plain numbers whose running state lives in a dict.

Their verbs, ``initialize_state`` and ``step_post_backward``, are called as those of gsplat's densification strategies. A
policy says when, :func:`sundae_ns.pruning.cutting.cut` does it. The state holds integers only, so that it can be stored in
a checkpoint and a resumed run neither prunes twice nor forgets its peak.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass, replace
from functools import partial
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
"""Of primitives that share one's looks; 3DGS-MCMC takes those below it for dead."""


@dataclass(frozen=True)
class PruningPolicy:
    """Base of the policies: the running state with its peak, and the report. Subclasses say when a prune is due."""

    config: PruningConfig
    """Options; not changed."""

    def due(self, state: Mapping[str, Any], step: int, n: int) -> bool:
        """Whether a field of ``n`` primitives is to be pruned after this step."""
        raise NotImplementedError

    def initialize_state(self) -> dict[str, Any]:
        """Running state: step of the last prune (-1 for none), number of prunes, most primitives so far."""
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
            info: taken for the sake of the common signature, not read.
            contribution: gives the summed blending weights over the training views for ``params`` as they are when it
                is called, which is after NaN and infinite primitives have gone ``[N]``; called only if the score needs
                it.
            strategy_state: state of a densification strategy on the same primitives; sliced with them.

        Returns:
            What was done, or None if nothing was due.

        Raises:
            ConfigError: the score needs a contribution and there is none.
            DataError: the field cannot be pruned, see :func:`decide`.
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
            count=partial(self._count, state),
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

    def _count(self, state: MutableMapping[str, Any], n: int) -> int | None:
        """Number of primitives to keep of ``n`` finite ones, or None for the keep ratio."""
        return None


class NoPruning(PruningPolicy):
    """Never prunes; the state still counts the peak, to compare with."""

    def due(self, state: Mapping[str, Any], step: int, n: int) -> bool:
        """Never."""
        return False


class OneShotPruning(PruningPolicy):
    """Training, then one prune down to ``keep_ratio``, then fine-tuning: the paper's main strategy.

    With ``rounds`` the prune is taken in that many steps, each by the same factor, ``round_every`` steps of training apart.
    The state holds how many primitives there were at first, so that the last round ends at the exact count.
    """

    def due(self, state: Mapping[str, Any], step: int, n: int) -> bool:
        """At ``prune_at``, or at once, if training went on from a later step without having pruned; then at the rounds."""
        config, done = self.config, state["num_prunes"]
        if state["pruned_at"] == NEVER:
            return step >= config.prune_at
        return done < config.rounds and step >= state["pruned_at"] + config.round_every

    def _count(self, state: MutableMapping[str, Any], n: int) -> int | None:
        config = self.config
        if config.rounds == 1:
            return None
        first = state.setdefault("first", n)
        done = state["num_prunes"] + 1
        return kept_count(config.keep_ratio ** (done / config.rounds), first)

    def _config_at(self, step: int) -> PruningConfig:
        if self.config.rounds == 1:
            return self.config
        # Another draw in each round, and after a resume the same as without it.
        return replace(self.config, seed=self.config.seed + step)


class ContinuousPruning(PruningPolicy):
    """Periodic pruning while densification goes on: a lower peak of memory.

    The alternative strategy of the paper (section "Continuous Pruning as a Strategy"), whose final count is loosely held:
    each prune goes by ``keep_ratio``. With ``target_primitives`` each goes down to exactly that count, the last one when
    densification has ended, which makes it the final count. ``max_primitives`` caps what a prune leaves, and every step in
    between, where densification has to be bounded by it (:class:`sundae_ns.training.densification.CappedStrategy`).
    """

    def due(self, state: Mapping[str, Any], step: int, n: int) -> bool:
        """At ``start`` and each ``every`` steps from there until ``stop``, towards a target only where there are more.

        From ``stop`` on whenever there are more than the target, or without one than the cap.
        """
        config, target = self.config, self.config.target_primitives
        scheduled = config.start <= step <= config.stop and (step - config.start) % config.every == 0
        most = config.max_primitives if target is None else target
        above = most is not None and n > most
        by_share = scheduled and target is None
        by_count = above and (scheduled or step >= config.stop)
        return (by_share or by_count) and step > state["pruned_at"]

    def _config_at(self, step: int) -> PruningConfig:
        # Another draw each time, and after a resume the same as without it.
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
        """Prune if it is due; where densification has ended with too few for ``target_primitives``, add those that lack.

        They are added on top of others, whose looks they share, so that no picture changes. What densification counted per
        primitive is forgotten then: it has ended.
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

    def _count(self, state: MutableMapping[str, Any], n: int) -> int | None:
        config = self.config
        if config.target_primitives is not None:
            return config.target_primitives
        count = kept_count(config.keep_ratio, n)
        return count if config.max_primitives is None else min(count, config.max_primitives)


def make_policy(config: PruningConfig) -> PruningPolicy:
    """Policy of the configured mode.

    Raises:
        ConfigError: an option cannot work.
    """
    config.validate()
    # Under auto a search cuts (pruning.search), and the policy counts.
    policies = {"off": NoPruning, "auto": NoPruning, "one-shot": OneShotPruning, "continuous": ContinuousPruning}
    return policies[config.mode](config)


def _now(params: Mapping[str, Tensor]) -> float:
    """Wall-clock seconds, after all work queued on the field's device."""
    device = params["means"].device
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
