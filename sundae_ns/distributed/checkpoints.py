"""Checkpoints of several ranks are those of one process: parts are gathered when saving, and cut out when loading."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from typing import Any

from sundae_ns.distributed.batches import scaled_group
from sundae_ns.distributed.shards import Shards, bounds
from sundae_ns.errors import CheckpointError
from sundae_ns.gaussians.surgery import per_primitive
from sundae_ns.training.schedules import NEVER

_FIELD = "_model.gauss_params."
_EXTRA = "_model._extra_state"


def whole_state(state: Mapping[str, Any], shards: Shards, names: Iterable[str]) -> dict[str, Any] | None:
    """A checkpoint of one GPU, in host memory on rank 0, from those of all ranks; None on the others. Collective.

    Args:
        state: what the trainer saves, of this rank.
        shards: the ranks.
        names: parameters of the field.
    """
    n = shards.counts[shards.rank]

    def gathered(value: Any) -> Any:
        return shards.gather(value, host=True) if per_primitive(value, n) else value

    made = _map_state(state, names, gathered, Fraction(1, shards.ranks))
    return made if shards.rank == 0 else None


def state_of_rank(loaded: Mapping[str, Any], rank: int, ranks: int, names: Iterable[str]) -> dict[str, Any]:
    """This rank's part of a checkpoint of one GPU.

    Args:
        loaded: the checkpoint.
        rank, ranks: whose part, of how many.
        names: parameters of the field.

    Returns:
        The part, which is of no primitive where there are fewer than ranks; the checkpoint as it is if it is another
        method's, which loading then says.

    Raises:
        CheckpointError: there is no primitive in the whole of it.
    """
    if not isinstance(loaded["pipeline"].get(_EXTRA), Mapping):
        return dict(loaded)
    n = len(loaded["pipeline"][_FIELD + "means"])
    if n == 0:
        raise CheckpointError("the checkpoint holds no primitives; give another")
    start, end = bounds(n, ranks)[rank : rank + 2]

    def part(value: Any) -> Any:
        return value[start:end].clone() if per_primitive(value, n) else value

    return _map_state(loaded, names, part, Fraction(ranks))


def _map_state(
    state: Mapping[str, Any], names: Iterable[str], change: Callable[[Any], Any], factor: Fraction
) -> dict[str, Any]:
    """A checkpoint with every per-primitive tensor changed, and rates and steps as of batches larger by a factor.

    The entries are gone through in an order that all ranks share.
    """

    def after(step: int) -> int:  # the last step of as many pictures; -1, before the first, stays
        return math.floor((step + 1) / factor) - 1

    def after_prune(step: int) -> int:
        # One in the midst of the first batch stays one: else the field would be pruned again.
        return step if step == NEVER else max(after(step), 0)

    pipeline = {key: change(value) if key.startswith(_FIELD) else value for key, value in state["pipeline"].items()}
    if _EXTRA in pipeline:
        extra = pipeline[_EXTRA]
        pipeline[_EXTRA] = {
            **extra,
            "step": after(extra["step"]),
            "strategy": {key: change(value) for key, value in extra["strategy"].items()},
            "pruning": {**extra["pruning"], "pruned_at": after_prune(extra["pruning"]["pruned_at"])},
        }
    optimizers, field = {}, set(names)
    for name, held in state["optimizers"].items():
        moments = held["state"]
        if name in field:
            moments = {
                key: {kind: value if kind == "step" else change(value) for kind, value in entries.items()}
                for key, entries in moments.items()
            }
        groups = held["param_groups"]
        if name in field:
            groups = [{**group, **scaled_group(group, float(factor))} for group in groups]
        optimizers[name] = {"state": moments, "param_groups": groups}
    schedulers = {}
    for name, held in state.get("schedulers", {}).items():
        growth = float(factor) ** 0.5 if name in field else 1.0
        rates = {key: [rate * growth for rate in held[key]] for key in ("base_lrs", "_last_lr")}
        decays = []
        for decay in held["lr_lambdas"]:
            spans = {key: round(decay[key] / factor) for key in ("max_steps", "warmup_steps")}
            pruned_at = decay["pruned_at"]
            decays.append({**decay, **spans, "pruned_at": None if pruned_at is None else after_prune(pruned_at)})
        schedulers[name] = {**held, **rates, "lr_lambdas": decays, "last_epoch": round(held["last_epoch"] / factor)}
    parts = {"pipeline": pipeline, "optimizers": optimizers, "schedulers": schedulers}
    return {**state, "step": after(state["step"]), **parts}
