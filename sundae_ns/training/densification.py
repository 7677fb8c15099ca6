"""How a field grows during the warm-up: gsplat's densification under a cap, or Markov chain Monte Carlo with one.

Both have the verbs of gsplat's strategies, and their running state holds ``peak``, the most primitives right after
growing, before anything is culled.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from gsplat.strategy import DefaultStrategy
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from sundae_ns.gaussians.relocation import grow, jitter, relocate

if TYPE_CHECKING:
    from sundae_ns.model import SundaeModelConfig


def limit_growth(
    state: MutableMapping[str, Any], small: Tensor, room: int, threshold: float, radius: float | None
) -> None:
    """Let at most ``room`` primitives be added: those with the highest gradients grow, others lose their statistics.

    Args:
        state: of gsplat's strategy, with ``grad2d`` and ``count`` ``[N]``, and ``radii`` ``[N]`` where it is used.
        small: those that a high gradient duplicates; it splits the others, bool ``[N]``.
        room: how many may be added: one by each that is duplicated or split, two by one that is both.
        threshold: mean gradient above which a primitive grows.
        radius: share of the picture above which it is split, None where it is not looked at.
    """
    gradients = state["grad2d"] / state["count"].clamp_min(1)
    high = gradients > threshold
    wide = torch.zeros_like(high)
    if radius is not None and state.get("radii") is not None:
        wide = state["radii"] > radius
    added = (high & small).long() + ((high & ~small) | wide).long()
    candidates = added.nonzero().squeeze(1)
    candidates = candidates[gradients[candidates].argsort(descending=True, stable=True)]
    left_out = candidates[added[candidates].cumsum(0) > room]
    state["grad2d"][left_out] = 0
    if radius is not None and state.get("radii") is not None:
        state["radii"][left_out] = state["radii"][left_out].clamp_max(radius)


class Statistics(NamedTuple):
    """What a backward pass has said about primitives in the views of several ranks; one may be in several rows."""

    ids: Tensor
    """Which primitive ``[S]``."""
    norms: Tensor
    """Length of the gradient of its centre, in units of half the picture; 0 where it is not drawn ``[S]``."""
    radii: Tensor
    """Its radius as a share of the picture's longer side; 0 where it is not drawn ``[S]``."""


@dataclass
class CappedStrategy(DefaultStrategy):
    """gsplat's densification, with an exact cap: where more would grow, those with the highest gradients do."""

    cap: int | None = None
    """Most primitives at any time; None for no cap."""

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """gsplat's state, and the peak."""
        return {**super().initialize_state(scene_scale), "peak": 0}

    @torch.no_grad()
    def _update_state(self, params: Any, state: dict[str, Any], info: dict[str, Any], packed: bool = False) -> None:
        """gsplat's; ``statistics`` of several ranks are added as they are, rows of zeros too, which waits for no GPU."""
        found: Statistics | None = info.get("statistics")
        if found is None:
            super()._update_state(params, state, info, packed=packed)
            return
        for name in ("grad2d", "count", "radii"):
            if name in state and state[name] is None:
                state[name] = torch.zeros(len(params["means"]), device=found.norms.device)
        norms, radii = found.norms.to(state["grad2d"]), found.radii.to(state["grad2d"])
        state["grad2d"].index_add_(0, found.ids, norms)
        state["count"].index_add_(0, found.ids, (radii > 0).to(state["count"]))
        if "radii" in state:
            state["radii"].scatter_reduce_(0, found.ids, radii, "amax")

    @torch.no_grad()
    def _grow_gs(self, params: Any, optimizers: Any, state: dict[str, Any], step: int) -> tuple[int, int]:
        if self.cap is not None:
            radius = self.grow_scale2d if step < self.refine_scale2d_stop_iter else None
            small = params["scales"].exp().amax(dim=-1) <= self.grow_scale3d * state["scene_scale"]
            limit_growth(state, small, self.cap - len(params["means"]), self.grow_grad2d, radius)
        grown = super()._grow_gs(params, optimizers, state, step)
        state["peak"] = max(state.get("peak", 0), len(params["means"]))
        return grown


def start_of_chain(params: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The field that the chain starts from: opacities of one half, and a tenth of the width, as in its paper.

    Args:
        params: the field from points ``[N, ...]``; it is not changed.
    """
    scales = params["scales"] + math.log(0.1)
    return {**params, "opacities": torch.zeros_like(params["opacities"]), "scales": scales}


@dataclass
class ChainStrategy:
    """3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al., 2024), in plain PyTorch, on any device.

    Transparent primitives are moved onto visible ones, a twentieth is added at a time until the cap is reached, and
    centres are moved by noise. Numbers are the paper's.
    """

    cap: int
    """Most primitives at any time."""
    refine_start_iter: int = 500
    """First step after which primitives are moved and added."""
    refine_stop_iter: int = 25000
    """Step from which on nothing is done any more."""
    refine_every: int = 100
    """Steps from one round to the next."""
    min_opacity: float = 0.005
    """Primitives below this are moved."""
    growth: float = 0.05
    """Share that is added in a round."""
    noise: float = 5e5
    """Noise of the centres, in units of their learning rate."""

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """The peak; nothing else is remembered from step to step."""
        return {"peak": 0}

    def step_pre_backward(self, *_: Any, **__: Any) -> None:
        """Nothing: no gradient is looked at."""

    @torch.no_grad()
    def step_post_backward(
        self,
        params: MutableMapping[str, Parameter],
        optimizers: Mapping[str, Optimizer],
        state: MutableMapping[str, Any],
        step: int,
        info: Mapping[str, Any] | None = None,
        packed: bool = False,
    ) -> None:
        """Move, add, and shake; call it after the optimizer's step."""
        if step >= self.refine_stop_iter:
            return
        if step > self.refine_start_iter and step % self.refine_every == 0:
            dead: Tensor = params["opacities"].detach().sigmoid().flatten() <= self.min_opacity
            relocate(params, optimizers, dead, self.min_opacity)
            n = len(params["means"])
            grow(params, optimizers, min(self.cap, int((1 + self.growth) * n)) - n, self.min_opacity)
            state["peak"] = max(state.get("peak", 0), len(params["means"]))
        jitter(params, self.noise * optimizers["means"].param_groups[0]["lr"])


def make_strategy(config: SundaeModelConfig, pictures: int) -> CappedStrategy | ChainStrategy:
    """How the field of a model grows, until the prune that would be undone by it.

    Args:
        config: of the model.
        pictures: how many the field is trained on; each is seen once after opacities are reset, before anything grows.
    """
    pruning, stop = config.pruning, config.stop_split_at
    continuous = pruning.mode == "continuous"
    ends = pruning.stop if continuous else pruning.ends_growth_at
    if ends is not None:
        stop = min(stop, ends)
    cap = pruning.max_primitives if continuous else None
    if config.warmup == "mcmc":
        return ChainStrategy(
            cap=min(config.mcmc_cap, cap or config.mcmc_cap),
            refine_start_iter=config.warmup_length,
            refine_stop_iter=stop,
            refine_every=config.refine_every,
        )
    return CappedStrategy(
        cap=cap,
        prune_opa=config.cull_alpha_thresh,
        grow_grad2d=config.densify_grad_thresh,
        grow_scale3d=config.densify_size_thresh,
        grow_scale2d=config.split_screen_size,
        prune_scale3d=config.cull_scale_thresh,
        prune_scale2d=config.cull_screen_size,
        refine_scale2d_stop_iter=config.stop_screen_size_at,
        refine_start_iter=config.warmup_length,
        refine_stop_iter=stop,
        reset_every=config.reset_alpha_every * config.refine_every,
        refine_every=config.refine_every,
        pause_refine_after_reset=pictures + config.refine_every,
        absgrad=config.use_absgrad,
        verbose=False,
    )
