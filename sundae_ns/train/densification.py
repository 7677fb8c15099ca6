"""Growth of a field: gsplat's densification under a cap.

Its running state holds ``peak``, the number of Gaussians right after growing and before culling.
"""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass
from typing import Any

import torch
from gsplat.strategy import DefaultStrategy
from torch import Tensor

from sundae_ns.core.values import usual_defaults
from sundae_ns.pruning.decision import diverged
from sundae_ns.train.state import Callback, TrainingRun, TrainingState

STATISTICS = ("grad2d", "count", "radii")  # Tensors [N] in the running state of gsplat's strategy

COUNTED = "counted"  # Entry of info of a step that has added its statistics: captured, or of several ranks


def limit_growth(
    state: MutableMapping[str, Any], small: Tensor, capacity: int, threshold: float, radius: float | None
) -> None:
    """Let at most ``capacity`` Gaussians be added, by the highest gradients; others lose their statistics.

    ``state`` of gsplat's strategy has ``grad2d`` and ``count`` ``[N]``, and ``radii`` ``[N]`` where it is used. A mean
    gradient above the ``threshold`` duplicates the Gaussians ``small``, bool ``[N]``, and splits the others, and those
    of a ``radius`` above this share of the image. One that is both adds two.
    """
    gradients = state["grad2d"] / state["count"].clamp_min(1)
    high = gradients > threshold
    radii = None if radius is None else state.get("radii")
    wide = torch.zeros_like(high) if radii is None else radii > radius
    added = (high & small).long() + ((high & ~small) | wide).long()
    candidates = added.nonzero().squeeze(1)
    candidates = candidates[gradients[candidates].argsort(descending=True, stable=True)]
    left_out = candidates[added[candidates].cumsum(0) > capacity]
    state["grad2d"][left_out] = 0
    if radii is not None:
        radii[left_out] = radii[left_out].clamp_max(radius)


def start_counting(state: MutableMapping[str, Any], means: Tensor) -> None:
    """Make the tensors that are missing in the running state of gsplat's strategy, for centres ``[N, 3]``."""
    for name in STATISTICS:
        if name in state and state[name] is None:
            state[name] = means.new_zeros(len(means))


@torch.no_grad()
def count_view(state: Mapping[str, Any], grads: Tensor, radii: Tensor, width: int, height: int) -> None:
    """Add the statistics of one view to the running state of gsplat's strategy, without waiting for the GPU.

    ``grads`` ``[N, 2]`` are those of the projected centres, per pixel; ``radii`` on the screen, pixels ``[N]``, or one
    per axis ``[N, 2]``, 0 where a Gaussian is not drawn; ``width`` and ``height`` those of the image, pixels.
    """
    drawn = radii > 0 if radii.ndim == 1 else (radii > 0).all(dim=-1)
    norms = torch.hypot(grads[:, 0] * (width / 2), grads[:, 1] * (height / 2))
    state["grad2d"].add_(torch.where(drawn, norms, 0.0))
    state["count"].add_(drawn)
    if state.get("radii") is not None:
        shares = (radii if radii.ndim == 1 else radii.amax(dim=-1)) / float(max(width, height))
        torch.maximum(state["radii"], torch.where(drawn, shares, 0.0), out=state["radii"])


@dataclass
class CappedStrategy(DefaultStrategy):
    """gsplat's densification with an exact cap: under it, the Gaussians with the highest gradients grow first."""

    cap: int | None = None  # Highest number of Gaussians; None for no cap

    def _update_state(self, params: Any, state: dict[str, Any], info: dict[str, Any], packed: bool = False) -> None:
        """Add the statistics of a step, unless they have been added."""
        if not info.get(COUNTED):
            super()._update_state(params, state, info, packed=packed)

    @torch.no_grad()
    def _grow_gs(self, params: Any, optimizers: Any, state: dict[str, Any], step: int) -> tuple[int, int]:
        if self.cap is not None:
            radius = self.grow_scale2d if step < self.refine_scale2d_stop_iter else None
            small = params["scales"].exp().amax(dim=-1) <= self.grow_scale3d * state["scene_scale"]
            limit_growth(state, small, self.cap - len(params["means"]), self.grow_grad2d, radius)
        grown = super()._grow_gs(params, optimizers, state, step)
        state["peak"] = max(state.get("peak", 0), len(params["means"]))
        return grown


class Densification(Callback):
    """Grows the Gaussians by gsplat's strategy until the schedule's prune would undo it."""

    name = "densification"

    def __init__(self, strategy: CappedStrategy) -> None:
        self.strategy = strategy

    def initialize(self, state: TrainingState) -> None:
        """Start the running state anew, as for a field that has not been trained."""
        state.densification.clear()
        state.densification.update(self.strategy.initialize_state(scene_scale=1.0), peak=0)

    def before_backward(self, state: TrainingState) -> None:
        """Keep the gradients that densification reads."""
        if state.densifying:
            self.strategy.step_pre_backward(
                state.gaussians.data, state.optimizers, state.densification, state.schedule_step, state.info
            )

    def after_step(self, run: TrainingRun) -> None:
        """Let the strategy add, move and remove Gaussians; ``DataError`` if none is left."""
        state = run.state
        if state.densifying:
            with usual_defaults():  # of the tensors that gsplat makes
                self.strategy.step_post_backward(
                    state.gaussians.data, state.optimizers, state.densification, state.schedule_step, state.info
                )
            if not state.gaussians.num_gaussians and run.images_per_step == 1:  # the shard of a rank may be empty
                raise diverged(0)


def make_strategy(options: Any, num_images: int) -> CappedStrategy:
    """Strategy of the densification, which ends before the prune that would undo it, by the options of the model."""
    pruning = options.pruning
    strategy = CappedStrategy(
        cap=pruning.cap,
        prune_opa=options.cull_alpha_thresh,
        grow_grad2d=options.densify_grad_thresh,
        grow_scale3d=options.densify_size_thresh,
        grow_scale2d=options.split_screen_size,
        prune_scale3d=options.cull_scale_thresh,
        prune_scale2d=options.cull_screen_size,
        refine_scale2d_stop_iter=options.stop_screen_size_at,
        refine_start_iter=options.warmup_length,
        refine_stop_iter=pruning.growth_ends_at(options.stop_split_at),
        reset_every=options.reset_alpha_every * options.refine_every,
        refine_every=options.refine_every,
        absgrad=options.use_absgrad,
        verbose=False,
    )
    # Opacities recover from a reset before anything grows; for half of the time if resets are closer.
    pause = num_images + strategy.refine_every
    if strategy.reset_every >= strategy.refine_stop_iter:
        pause = 0  # gsplat also waits at the start of a run that never resets
    elif pause >= strategy.reset_every:
        pause = strategy.reset_every // 2
    strategy.pause_refine_after_reset = pause
    return strategy
