"""Checkpoints of several ranks, in the format of one process: shards are gathered to save and cut out to load."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from typing import Any

from sundae_ns.distributed.batches import scaled_group
from sundae_ns.distributed.shards import Shards, bounds
from sundae_ns.errors import CheckpointError
from sundae_ns.gaussians.surgery import per_primitive
from sundae_ns.storage.runs.checkpoint import FORMAT
from sundae_ns.training.schedules import NEVER

_FIELD = "_model.gauss_params."
_EXTRA = "_model._extra_state"


def whole_state(state: Mapping[str, Any], shards: Shards, names: Iterable[str]) -> dict[str, Any] | None:
    """The checkpoint of the whole field, in host memory on rank 0; None on the others. Collective."""
    n = shards.counts[shards.rank]

    def gathered(value: Any) -> Any:
        return shards.gather(value, host=True) if per_primitive(value, n) else value

    made = _map_state(state, names, gathered, Fraction(1, shards.ranks))
    return made if shards.rank == 0 else None


def state_of_rank(loaded: Mapping[str, Any], rank: int, ranks: int, names: Iterable[str]) -> dict[str, Any]:
    """The part of a whole checkpoint that a rank holds; ``names`` are those of the parameters of the field.

    Returns:
        The part, empty if there are fewer primitives than ranks. A checkpoint of another method or format is returned
        unchanged; loading refuses it.

    Raises:
        CheckpointError: the checkpoint holds no primitives.
    """
    extra = loaded["pipeline"].get(_EXTRA)
    if not isinstance(extra, Mapping) or extra.get("format") != FORMAT:
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
    """A checkpoint with every per-primitive tensor changed, and with rates and steps of batches larger by a factor.

    All ranks visit the entries in the same order.
    """

    def after(step: int) -> int:  # the last step of as many images; -1, before the first, stays
        return math.floor((step + 1) / factor) - 1

    def after_prune(step: int) -> int:
        # A prune within the first batch must not become -1, or the field would be pruned again.
        return step if step == NEVER else max(after(step), 0)

    pipeline = {key: change(value) if key.startswith(_FIELD) else value for key, value in state["pipeline"].items()}
    if _EXTRA in pipeline:
        extra = pipeline[_EXTRA]
        running = extra["running"]
        pipeline[_EXTRA] = {
            **extra,
            "step": after(extra["step"]),
            "running": {
                "densification": {key: change(value) for key, value in running["densification"].items()},
                "pruning": {**running["pruning"], "pruned_at": after_prune(running["pruning"]["pruned_at"])},
            },
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
