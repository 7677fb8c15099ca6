"""One field over several ranks: who holds which primitives, and how the ranks act as one.

The design is in ``docs/distributed.md``.

Collectives are those of ``torch.distributed`` on the default process group. Functions that say "collective" are to be
called by all ranks, in the same order.
"""

from __future__ import annotations

import math
import random
import tempfile
from collections.abc import Callable, Iterable, Mapping, MutableMapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from datetime import timedelta
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import torch.distributed as dist
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import track
from torch import Tensor
from torch.multiprocessing.spawn import ProcessExitedException, ProcessRaisedException
from torch.nn import Parameter
from torch.optim import Optimizer

from sundae_ns.errors import ConfigError, DataError, SundaeError, rank_ended
from sundae_ns.gaussians import FEATURES
from sundae_ns.gaussians.parameters import finite_mask, num_primitives
from sundae_ns.gaussians.rewriting import rewrite
from sundae_ns.gaussians.surgery import check_wiring
from sundae_ns.pruning import PruneReport, PruningConfig
from sundae_ns.pruning.policy import PruningPolicy
from sundae_ns.pruning.scores import Contribution
from sundae_ns.rasterization.reference import per_axis
from sundae_ns.rasterization.sharded import (
    Camera,
    Route,
    exchange,
    gather_cameras,
    give_back,
    may_be_seen,
    plan_route,
    swap,
)

if TYPE_CHECKING:
    from sundae_ns.model import SundaeModel
    from sundae_ns.views import View

DRIFT = 1.1
"""Rows move when the largest shard has more than this times the mean."""
TIMEOUT = timedelta(minutes=30)
"""Of a collective. Rank 0 prunes and saves while others wait, so it is long; the death of a rank is noticed without it."""
_FIELD = "_model.gauss_params."
_EXTRA = "_model._extra_state"
_GEOMETRY = ("means", "quats", "scales", "opacities")
_COLORS = ("features_dc", "features_rest")


# --------------------------------------------------------------------------------------------------------------- blocks


def bounds(total: int, ranks: int) -> list[int]:
    """Where the blocks of ``total`` rows begin, and where the last one ends: ``ranks + 1`` numbers.

    Blocks differ by at most one row.
    """
    return [total * rank // ranks for rank in range(ranks + 1)]


def moves(counts: Sequence[int], rank: int) -> tuple[list[int], list[int]]:
    """How many rows a rank sends to and gets from each, so that all have as many, and the order stays.

    Args:
        counts: rows of each rank now.
        rank: which rank asks.
    """
    ranks, new = len(counts), bounds(sum(counts), len(counts))
    old = [sum(counts[:r]) for r in range(ranks + 1)]

    def shared(holder: int, taker: int) -> int:
        return max(0, min(old[holder + 1], new[taker + 1]) - max(old[holder], new[taker]))

    return [shared(rank, other) for other in range(ranks)], [shared(other, rank) for other in range(ranks)]


class Arrived(dict[str, Tensor]):
    """Primitives that have come to this rank for one view, by the names of the parameters, and ``colors`` ``[M, 3]``."""

    route: Route


class Shards:
    """This rank's place among the ranks, and how many primitives each holds.

    Args:
        device: of the field; tensors of collectives are on it.
    """

    def __init__(self, device: torch.device | str) -> None:
        self.rank, self.ranks = dist.get_rank(), dist.get_world_size()
        self.device = torch.device(device)
        self.counts = [0] * self.ranks
        """Primitives of each rank."""

    @property
    def total(self) -> int:
        """Primitives of all ranks."""
        return sum(self.counts)

    def numbers(self, *own: int) -> list[list[int]]:
        """Some whole numbers of each rank, by rank. Collective."""
        mine = torch.tensor(own, device=self.device)
        every = [torch.empty_like(mine) for _ in range(self.ranks)]
        dist.all_gather(every, mine)
        return [row.tolist() for row in every]

    def recount(self, params: Mapping[str, Tensor]) -> None:
        """Let every rank know what each holds. Collective."""
        self.counts = [count for (count,) in self.numbers(num_primitives(params))]

    def announce(self, thing: Any) -> Any:
        """What rank 0 says, a plain value, on every rank. Collective."""
        box = [thing]
        dist.broadcast_object_list(box, src=0, device=self.device)
        return box[0]

    def gather(self, rows: Tensor, *, host: bool = False) -> Tensor | None:
        """Rows of all ranks, in order, on rank 0; None on the others. Collective.

        Args:
            rows: per-primitive values of this rank ``[N_r, ...]``.
            host: gather in host memory, so that the GPU has to hold no more than one other rank's rows.
        """
        rows = rows.detach().contiguous()
        if self.rank != 0:
            if len(rows):
                dist.send(rows, 0)
            return None
        parts = [rows.cpu() if host else rows]
        for other, count in enumerate(self.counts[1:], start=1):
            part = rows.new_empty(count, *rows.shape[1:])
            if count:
                dist.recv(part, other)
            parts.append(part.cpu() if host else part)
        return torch.cat(parts)

    @torch.no_grad()
    def level(
        self,
        params: MutableMapping[str, Parameter],
        optimizers: Mapping[str, Optimizer],
        states: Iterable[MutableMapping[str, Any]],
        mask: Tensor | None = None,
    ) -> None:
        """Move rows until all ranks hold as many, in the same order; with a mask, of those alone that stay. Collective.

        Parameters are replaced as :func:`sundae_ns.gaussians.surgery.keep` replaces them: gradients are not carried over,
        moments are, and other holders of the old ones are to be refreshed.

        Args:
            params: this rank's primitives ``[N_r, ...]``.
            optimizers: of one parameter each, by name; others are left alone.
            states: running states; their tensors of N_r rows move too.
            mask: True for primitives that stay, bool ``[N_r]``; None for all.
        """
        check_wiring(params, optimizers)
        n = num_primitives(params)
        kept = [count for (count,) in self.numbers(n if mask is None else int(mask.sum()))]
        sent, received = moves(kept, self.rank)

        def moved(value: Tensor) -> Tensor:
            return swap(value if mask is None else value[mask], sent, received)

        for name, old in list(params.items()):
            new = Parameter(moved(old.detach()), requires_grad=old.requires_grad)
            if name in optimizers:
                optimizer = optimizers[name]
                moments = optimizer.state.pop(old, None)
                if moments is not None:
                    optimizer.state[new] = {
                        key: moved(value) if key != "step" and isinstance(value, Tensor) else value
                        for key, value in moments.items()
                    }
                optimizer.param_groups[0]["params"] = [new]
            params[name] = new
        for state in states:
            state.update({key: moved(value) for key, value in state.items() if _per_primitive(value, n)})
        self.counts = [end - start for start, end in zip(*_pairs(bounds(sum(kept), self.ranks)))]

    # ---------------------------------------------------------------------------------------------------- rendering

    def arrivals(
        self,
        params: Mapping[str, Tensor],
        view: View,
        colors_of: Callable[[Mapping[str, Tensor], View | Camera], Tensor],
        *,
        near_plane: float,
        features: bool,
    ) -> Arrived:
        """The primitives of all ranks that this rank's view may see; differentiable. Collective.

        Args:
            params: this rank's primitives.
            view: this rank's camera.
            colors_of: colours ``[n, 3]``, as a camera sees them, of primitives with centres and harmonics.
            near_plane: as the rasteriser gets it.
            features: whether features come along.
        """
        names = [*_GEOMETRY, FEATURES] if features else list(_GEOMETRY)
        cameras = gather_cameras(view.viewmat.detach(), view.K, view.width, view.height)
        with torch.no_grad():
            scales = params["scales"].exp()
            ids = [may_be_seen(params["means"], scales, c, near_plane, math.inf).nonzero()[:, 0] for c in cameras]
        route = plan_route(ids)
        # Picked for all cameras at once: the way back then fills one gradient per parameter, not one per camera.
        going = {name: params[name].index_select(0, route.ids) for name in [*names, *_COLORS]}
        parts = zip(*(going[name].split(route.sent) for name in ("means", *_COLORS)))
        colors = [colors_of(dict(zip(("means", *_COLORS), part)), camera) for part, camera in zip(parts, cameras)]
        rows = torch.cat([*(going[name] for name in names), torch.cat(colors)], dim=1)
        columns = [params[name].shape[1] for name in names]
        pieces = exchange(rows, route).split([*columns, 3], dim=1)
        arrived = Arrived(zip([*names, "colors"], pieces))
        arrived.route = route
        return arrived

    @torch.no_grad()
    def statistics(self, info: Mapping[str, Any], *, absgrad: bool) -> dict[str, Any]:
        """What gsplat's strategy reads after a backward pass, about this rank's primitives in all views. Collective.

        Args:
            info: of this rank's view, with its ``route``.
            absgrad: whether gradients are summed by their absolute values.

        Returns:
            ``info`` of a packed rasterisation, in units of half the picture: its width and height are 2.
        """
        route: Route = info["route"]
        centres = info["means2d"]
        gradients = (centres.absgrad if absgrad else centres.grad)[0]
        radii = info["radii"][0]
        radii = (radii if radii.dim() == 1 else radii.amax(dim=-1)).to(gradients.dtype)
        width, height = info["width"], info["height"]
        halves = gradients.new_tensor([width / 2, height / 2])
        found = torch.cat([gradients * halves, (radii * (2 / max(width, height)))[:, None]], dim=1)
        found = give_back(found, route)
        seen = found[:, 2] > 0
        ids, found = route.ids[seen], found[seen]
        # The strategy writes radii row by row: of a primitive in several views, each row gets the largest.
        largest = found.new_zeros(self.counts[self.rank]).scatter_reduce_(0, ids, found[:, 2], "amax")
        packed = found[:, :2].clone()
        packed.grad = found[:, :2].clone()
        packed.absgrad = packed.grad  # type: ignore[attr-defined]
        return {
            "width": 2,
            "height": 2,
            "n_cameras": 1,
            "radii": per_axis(largest[ids]),
            "gaussian_ids": ids,
            "means2d": packed,
        }

    def densify(self, model: SundaeModel) -> None:
        """Densify every shard by itself, and level the shards when they have drifted apart. Collective."""
        strategy, state = model.strategy, model.strategy_state
        peak, state["peak"] = state["peak"], 0
        info = self.statistics(model.info, absgrad=model.config.use_absgrad)
        params = model.gaussians
        strategy.step_post_backward(
            params=model.gauss_params,
            optimizers=model.optimizers,
            state=state,
            step=model.schedule_step,
            info=info,
            packed=True,
        )
        if model.schedule_step % strategy.refine_every == 0:
            numbers = self.numbers(num_primitives(params), max(state["peak"], num_primitives(params)))
            self.counts = [count for count, _ in numbers]
            peak = max(peak, sum(most for _, most in numbers))
            if max(self.counts) > DRIFT * self.total / self.ranks:
                self.level(params, model.optimizers, [state])
        state["peak"] = peak

    @torch.no_grad()
    def contribution(self, model: SundaeModel, cameras: Sequence[Any], share: float | None) -> Tensor:
        """Blending weights of this rank's primitives, summed over all views in their order ``[N_r]``. Collective.

        Args:
            model: the model.
            cameras: every training camera; each rank draws one of every R.
            share: see :meth:`sundae_ns.model.SundaeModel.weights_of`.
        """
        sums = torch.zeros(self.counts[self.rank], device=self.device)
        rounds = range(0, len(cameras), self.ranks)
        for first in track(rounds, description="Contribution of primitives", transient=True, console=CONSOLE):
            # Where views run out the last is drawn again, since all ranks have to take part, and not counted.
            view = model.view_of(cameras[min(first + self.rank, len(cameras) - 1)])
            arrived = model.arrivals(model.gaussians, view)
            weights = give_back(model.weights_of(view, share, arrived)[:, None], arrived.route)[:, 0]
            by_view = zip(arrived.route.ids.split(arrived.route.sent), weights.split(arrived.route.sent))
            for ids, added in list(by_view)[: len(cameras) - first]:
                sums[ids] += added
        return sums

    def agree_on_focal(self, model: SundaeModel) -> None:
        """Let all ranks know the focal lengths of the pictures that any has trained the head on. Collective."""
        low, high = model.trained_focal or (math.inf, -math.inf)
        ends = torch.tensor([low, -high], device=self.device, dtype=torch.float64)
        dist.all_reduce(ends, dist.ReduceOp.MIN)
        low, high = ends.tolist()
        model.trained_focal = None if math.isinf(low) else (low, -high)


def _pairs(ends: list[int]) -> tuple[list[int], list[int]]:
    return ends[:-1], ends[1:]


def _per_primitive(value: Any, n: int) -> bool:
    return isinstance(value, Tensor) and value.ndim > 0 and value.shape[0] == n


# -------------------------------------------------------------------------------------------------------------- pruning


@dataclass(frozen=True)
class GlobalPruning:
    """A pruning policy over the shards of one field: what one process decides for the whole field, all ranks do."""

    policy: PruningPolicy
    shards: Shards

    @property
    def config(self) -> PruningConfig:
        """Options of the policy."""
        return self.policy.config

    def due(self, state: Mapping[str, Any], step: int, n: int) -> bool:
        """Whether the field is to be pruned after this step."""
        return self.policy.due(state, step, n)

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
        """Prune if it is due; arguments and errors as of the policy's own, for this rank's primitives. Collective."""
        shards, before = self.shards, self.shards.total
        state["peak"] = max(state["peak"], before)
        if not self.policy.due(state, step, before):
            return None
        states = [] if strategy_state is None else [strategy_state]
        finite = finite_mask(params)
        dropped = before - sum(count for (count,) in shards.numbers(int(finite.sum())))
        if dropped == before:
            raise DataError(
                f"none of {before} primitives is finite: the training has diverged, go back to an earlier checkpoint"
            )
        if dropped:
            shards.level(params, optimizers, states, finite)
        needed = contribution is not None and self.config.uses_contribution and self.config.keep_ratio < 1
        sums = shards.gather(contribution()) if contribution is not None and needed else None
        whole = {name: shards.gather(value) for name, value in params.items()}

        outcome: Any = None
        rows = torch.empty(0, dtype=torch.bool, device=shards.device)
        if shards.rank == 0:
            outcome, whole, rows = _decide(self.policy, whole, state, step, sums)
        outcome = shards.announce(outcome)
        if isinstance(outcome, SundaeError):
            raise outcome
        report, counted, changed = outcome
        state.update(counted)

        mask = torch.zeros(shards.total, dtype=torch.bool, device=shards.device)
        if shards.rank == 0:
            mask[rows] = True
        dist.broadcast(mask, 0)
        start = sum(shards.counts[: shards.rank])
        shards.level(params, optimizers, states, mask[start : start + num_primitives(params)])
        start = sum(shards.counts[: shards.rank])
        values = {}
        for name in changed:
            value = params[name].new_empty(shards.total, *params[name].shape[1:])
            if shards.rank == 0:
                value.copy_(whole[name])  # type: ignore[arg-type]
            dist.broadcast(value, 0)
            values[name] = value[start : start + num_primitives(params)].clone()
        rewrite(params, optimizers, values)
        # In pictures, as checkpoints have it.
        return replace(report, step=(step + 1) * shards.ranks - 1, before=before, dropped_nonfinite=dropped)


def _decide(
    policy: PruningPolicy, field: Mapping[str, Any], state: Mapping[str, Any], step: int, sums: Tensor | None
) -> tuple[Any, dict[str, Any], Tensor]:
    """What the policy makes of a whole field: outcome for all ranks, the field after it, and the rows that stayed."""
    params: dict[str, Any] = {name: Parameter(value.clone(), requires_grad=False) for name, value in field.items()}
    rows = torch.arange(num_primitives(params), device=params["means"].device)
    # Surgery slices every per-primitive tensor of the state, so this one comes out as the rows that stayed.
    counted: dict[str, Any] = {**state, "rows": rows}
    try:
        report = policy.step_post_backward(
            params, {}, counted, step, contribution=None if sums is None else lambda: sums
        )
    except SundaeError as error:
        return error, params, rows
    rows = counted.pop("rows")
    changed = [name for name, value in params.items() if not torch.equal(value, field[name][rows])]
    return (report, counted, changed), params, rows


# ---------------------------------------------------------------------------------------------------------- optimizers


class SharedOptimizers(Optimizers):
    """nerfstudio's optimizers, where some groups are copies of which every rank has one: their gradients are averaged."""

    replicated: tuple[str, ...] = ("compensation",)

    def optimizer_scaler_step_some(self, grad_scaler: Any, param_groups: list[str]) -> None:
        """Average, then step. Collective."""
        for name in self.replicated:
            if name in param_groups:
                average_gradients(self.parameters[name])
        super().optimizer_scaler_step_some(grad_scaler, param_groups)


@torch.no_grad()
def average_gradients(params: Iterable[Tensor]) -> None:
    """Give copies of parameters the mean of their gradients over the ranks. Collective, in one message.

    Args:
        params: the same on all ranks, and the same of them with a gradient.
    """
    gradients = [value.grad for value in params if value.grad is not None]
    if not gradients:
        return
    flat = torch.cat([gradient.flatten() for gradient in gradients])
    dist.all_reduce(flat)
    flat /= dist.get_world_size()
    for gradient, mean in zip(gradients, flat.split([gradient.numel() for gradient in gradients])):
        gradient.copy_(mean.view_as(gradient))


def scale_rates(optimizers: Optimizers, ranks: int) -> None:
    """Adapt Adam to batches of ``ranks`` pictures: rates by the square root, both betas to that power.

    Source: Zhao et al., "On Scaling Up 3D Gaussian Splatting Training" (Grendel-GS), 2024.
    """
    for optimizer in optimizers.optimizers.values():
        for group in optimizer.param_groups:
            group.update(_scaled_group(group, ranks))
    for scheduler in optimizers.schedulers.values():
        for name in ("base_lrs", "_last_lr"):
            setattr(scheduler, name, [rate * ranks**0.5 for rate in getattr(scheduler, name)])


def _scaled_group(group: Mapping[str, Any], factor: float) -> dict[str, Any]:
    scaled = {name: group[name] * factor**0.5 for name in ("lr", "initial_lr") if name in group}
    if "betas" in group:
        # Rounded, so that a power and its root give the number that they began with.
        scaled["betas"] = tuple(round(beta**factor, 12) for beta in group["betas"])
    return scaled


# ---------------------------------------------------------------------------------------------------------- checkpoints


def whole_state(state: Mapping[str, Any], shards: Shards, names: Iterable[str]) -> dict[str, Any] | None:
    """A checkpoint of one GPU, in host memory on rank 0, from those of all ranks; None on the others. Collective.

    Args:
        state: what the trainer saves, of this rank.
        shards: the ranks.
        names: parameters of the field.
    """
    n = shards.counts[shards.rank]

    def gathered(value: Any) -> Any:
        return shards.gather(value, host=True) if _per_primitive(value, n) else value

    made = _map_state(state, names, gathered, Fraction(1, shards.ranks))
    return made if shards.rank == 0 else None


def state_of_rank(loaded: Mapping[str, Any], rank: int, ranks: int, names: Iterable[str]) -> dict[str, Any]:
    """This rank's part of a checkpoint of one GPU.

    Args:
        loaded: the checkpoint.
        rank, ranks: whose part, of how many.
        names: parameters of the field.

    Returns:
        The part; the checkpoint as it is if it is another method's, which loading then says.
    """
    if not isinstance(loaded["pipeline"].get(_EXTRA), Mapping):
        return dict(loaded)
    n = len(loaded["pipeline"][_FIELD + "means"])
    start, end = bounds(n, ranks)[rank : rank + 2]

    def part(value: Any) -> Any:
        return value[start:end].clone() if _per_primitive(value, n) else value

    return _map_state(loaded, names, part, Fraction(ranks))


def _map_state(
    state: Mapping[str, Any], names: Iterable[str], change: Callable[[Any], Any], factor: Fraction
) -> dict[str, Any]:
    """A checkpoint with every per-primitive tensor changed, and rates and steps as of batches larger by a factor.

    The entries are gone through in an order that all ranks share.
    """

    def after(step: int) -> int:  # the last step of as many pictures; -1, before the first, stays
        return math.floor((step + 1) / factor) - 1

    pipeline = {key: change(value) if key.startswith(_FIELD) else value for key, value in state["pipeline"].items()}
    if _EXTRA in pipeline:
        extra = pipeline[_EXTRA]
        pipeline[_EXTRA] = {
            **extra,
            "step": after(extra["step"]),
            "strategy": {key: change(value) for key, value in extra["strategy"].items()},
            "pruning": {**extra["pruning"], "pruned_at": after(extra["pruning"]["pruned_at"])},
        }
    optimizers, field = {}, set(names)
    for name, held in state["optimizers"].items():
        moments = held["state"]
        if name in field:
            moments = {
                key: {kind: value if kind == "step" else change(value) for kind, value in entries.items()}
                for key, entries in moments.items()
            }
        groups = [{**group, **_scaled_group(group, float(factor))} for group in held["param_groups"]]
        optimizers[name] = {"state": moments, "param_groups": groups}
    schedulers = {}
    for name, held in state.get("schedulers", {}).items():
        rates = {key: [rate * float(factor) ** 0.5 for rate in held[key]] for key in ("base_lrs", "_last_lr")}
        decays = []
        for decay in held["lr_lambdas"]:
            spans = {key: round(decay[key] / factor) for key in ("max_steps", "warmup_steps")}
            pruned_at = decay["pruned_at"]
            decays.append({**decay, **spans, "pruned_at": None if pruned_at is None else after(pruned_at)})
        schedulers[name] = {**held, **rates, "lr_lambdas": decays, "last_epoch": round(held["last_epoch"] / factor)}
    parts = {"pipeline": pipeline, "optimizers": optimizers, "schedulers": schedulers}
    return {**state, "step": after(state["step"]), **parts}


# ------------------------------------------------------------------------------------------------------- start and end


def check_options(config: Any) -> None:
    """Refuse what several ranks cannot do yet, before anything is trained.

    Args:
        config: ``SundaeTrainerConfig``.

    Raises:
        ConfigError: the first option that does not fit.
    """
    model = config.pipeline.model
    pruning = model.pruning
    counted = pruning.max_primitives is not None or pruning.target_primitives is not None
    refused = {
        "--pipeline.model.warmup mcmc": model.warmup == "mcmc",
        "--pipeline.model.pruning.mode auto": pruning.mode == "auto",
        "continuous pruning to a count or under a cap": pruning.mode == "continuous" and counted,
        "a camera optimizer": model.camera_optimizer.mode != "off",
        "--mixed-precision": config.mixed_precision or config.use_grad_scaler,
        "--gradient-accumulation-steps": bool(config.gradient_accumulation_steps),
    }
    for name, given in refused.items():
        if given:
            raise ConfigError(f"{name} does not work on several GPUs yet; leave it out, or use --machine.num-devices 1")


def check_machine(ranks: int, device_type: str) -> None:
    """Refuse more ranks than ``ns-train`` can start here.

    Raises:
        ConfigError: the ranks are not on GPUs, or there are not so many.
    """
    if device_type != "cuda":
        raise ConfigError(
            f"--machine.num-devices {ranks} needs GPUs, and --machine.device-type is {device_type}; "
            "give --machine.num-devices 1"
        )
    found = torch.cuda.device_count()
    if ranks > found:
        raise ConfigError(
            f"--machine.num-devices is {ranks} and there are {found} GPUs; give --machine.num-devices {max(found, 1)}"
        )


def without_viewer(vis: str) -> str:
    """The same choice of loggers without the viewer, which could show one rank's primitives only."""
    return "tensorboard" if vis in ("viewer", "viewer_legacy") else vis.removeprefix("viewer+")


def take_shard(model: SundaeModel, seed: int) -> Shards:
    """Give all ranks the field and the head of rank 0, and let each keep its block of the field. Collective.

    Args:
        model: as it was made, with as many primitives on each rank.
        seed: of what all ranks have to draw alike, such as the picture to evaluate.
    """
    shards = Shards(model.device)
    head = [] if model.head is None else [*model.head.parameters(), *model.head.buffers()]
    for value in [*model.gauss_params.values(), *head]:
        dist.broadcast(value.data, 0)
    start, end = bounds(model.num_points, shards.ranks)[shards.rank : shards.rank + 2]
    for value in model.gauss_params.values():
        value.data = value.data[start:end].clone()
    shards.recount(model.gaussians)
    random.seed(seed)
    return shards


def shorten(config: Any, ranks: int) -> Any:
    """A copy of a configuration whose steps are divided by ``ranks``: as many pictures, in larger batches.

    Args:
        config: ``SundaeTrainerConfig``.
        ranks: pictures of a step.
    """
    config = deepcopy(config)
    model = config.pipeline.model
    steps: tuple[tuple[Any, str], ...] = (
        (config, "max_num_iterations steps_per_save steps_per_eval_image steps_per_eval_all_images"),
        (model.pruning, "prune_at round_every start stop every"),
        (model.head, "start_at"),
        (model, "warmup_length refine_every resolution_schedule sh_degree_interval stop_screen_size_at stop_split_at"),
    )
    for owner, names in steps:
        for name in names.split():
            value = getattr(owner, name)
            if value:
                setattr(owner, name, max(1, round(value / ranks)))
    for group in config.optimizers.values():
        scheduler = group["scheduler"]
        if scheduler is not None:
            scheduler.max_steps = max(1, round(scheduler.max_steps / ranks))
            scheduler.warmup_steps = round(getattr(scheduler, "warmup_steps", 0) / ranks)
    return config


def launch(config: Any, ranks: int) -> None:
    """Train on several processes of this machine's CPU, over gloo; on GPUs ``ns-train`` starts the ranks itself.

    Args:
        config: ``SundaeTrainerConfig`` for a CPU.
        ranks: how many.

    Raises:
        RankError: a rank has ended before its time; by then all have.
    """
    with tempfile.TemporaryDirectory() as folder:
        context = torch.multiprocessing.spawn(
            _train, (ranks, Path(folder) / "meeting", config), nprocs=ranks, join=False
        )
        try:
            while not context.join():
                pass
        except (ProcessExitedException, ProcessRaisedException) as error:
            raise rank_ended(error) from error


def _train(rank: int, ranks: int, meeting: Path, config: Any) -> None:
    dist.init_process_group("gloo", init_method=f"file://{meeting}", rank=rank, world_size=ranks, timeout=TIMEOUT)
    torch.manual_seed(config.machine.seed + rank)
    trainer = config.setup(local_rank=rank, world_size=ranks)
    trainer.setup()
    trainer.train()
    dist.destroy_process_group()
