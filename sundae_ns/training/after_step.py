"""What follows a step of training: the prune, when it is due, and the record of it."""

from __future__ import annotations

import json
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE

from sundae_ns.datamanager import SundaeDatamanager
from sundae_ns.errors import SundaeError
from sundae_ns.evaluation import peak_memory
from sundae_ns.storage.atomic import write_text
from sundae_ns.storage.runs.folder import prunes_before
from sundae_ns.training.report import PruneReport
from sundae_ns.training.schedulers import notify_pruned

if TYPE_CHECKING:
    from sundae_ns.model import SundaeModel


def prune_if_due(model: SundaeModel, attributes: TrainingCallbackAttributes, step: int) -> None:
    """Let the policy, or the search for a budget, do what is due, and record it.

    Raises:
        SundaeError: the field cannot be pruned so; a checkpoint is saved first.
    """
    optimizers, pipeline = attributes.optimizers, attributes.pipeline
    assert optimizers is not None
    assert pipeline is not None
    pruning = model.config.pruning
    # Between growing and culling there were more than now.
    peaks = (model.pruning_state["peak"], model.strategy_state.get("peak", 0))
    model.pruning_state["peak"] = max(peaks)
    due = model.policy.due(model.pruning_state, model.schedule_step, model.total_points)
    evaluate = due and model.config.evaluate_prune and pruning.ends_growth_at is not None
    before = _evaluate(model, pipeline, "warm-up", step) if evaluate else {}
    try:
        report = model.policy.step_post_backward(
            model.gaussians,
            optimizers.optimizers,
            model.pruning_state,
            model.schedule_step,
            strategy_state=model.strategy_state,
            contribution=partial(model.contribution, cast(SundaeDatamanager, pipeline.datamanager)),
        )
        if model.budget is not None:
            model.budget.after_step(model, attributes)
    except SundaeError:
        # The warm-up should not be lost to an option that can be mended: resuming prunes at the first step.
        if attributes.trainer is not None:
            attributes.trainer.save_checkpoint(step)
        raise
    refresh(model, optimizers)
    settled = model.schedule_step >= pruning.settled_at
    pruned = settled or (pruning.ends_growth_at is not None and model.pruning_state["num_prunes"] > 0)
    if model.budget is None and pruned:
        notify_pruned(optimizers.schedulers, step, last=settled and model.schedule_step >= model.head_starts_at)
    if report is None:
        return
    CONSOLE.log(report.summary())
    if report.dropped_nonfinite:
        CONSOLE.print(f"[yellow]Warning: dropped {report.dropped_nonfinite} primitives that were not finite")
    after = _evaluate(model, pipeline, "pruned", step) if evaluate else {}
    record(model, attributes, report, step, before=before, after=after)


def warn_if_too_short(model: SundaeModel, last_step: int) -> None:
    """Say so where a training that ends with this step does not come to its first prune, its last, or its head."""
    short = _short_of(model, last_step)
    if short is None:
        return
    what, due, option, found = short
    ranks = 1 if model.shards is None else model.shards.ranks
    mend = "start it" if option.startswith("head") else "prune"
    # Steps of one picture, which options count by.
    CONSOLE.print(
        f"[yellow]Warning: training ends after {(last_step + 1) * ranks:,} steps, and the {what} needs more than "
        f"{due * ranks:,} ({option}): {found}; train longer, or {mend} earlier",
        soft_wrap=True,
    )


def _short_of(model: SundaeModel, last_step: int) -> tuple[str, int, str, str] | None:
    """What such a training does not come to, the step that it needs more than, its option, and what becomes of it."""
    pruning, warm = model.config.pruning, model.config.warm_start is not None
    offset = pruning.prune_at if warm else 0
    first, done, target = pruning.first_prune, model.pruning_state["num_prunes"], pruning.target_primitives
    begins, ends = "prune-at", "rounds" if pruning.rounds > 1 else "prune-at"
    if pruning.mode == "continuous":
        begins, ends = "start", "stop"
    idle = model.head is not None and model.budget is None and last_step + offset <= model.head_starts_at
    and_head = ", and the head takes no part" if idle else ""
    # A warm start is pruned at once.
    if first is not None and not warm:
        if last_step < first and not done:
            return "first prune", first, f"pruning.{begins}", "nothing is pruned" + and_head
        if last_step < pruning.last_due and not (done and target is not None and model.total_points <= target):
            found = "more primitives are left than asked for" + and_head
            return "last prune", pruning.last_due, f"pruning.{ends}", found
    if not idle:
        return None
    option = f"pruning.{ends}" if model.config.head.start_at is None else "head.start-at"
    # It takes part in the steps after that one.
    return "head", model.head_starts_at + 1 - offset, option, "it takes no part"


def finish(model: SundaeModel, attributes: TrainingCallbackAttributes, step: int) -> None:
    """Say what training took at its peak, and whether a budget was met or nothing was pruned."""
    primitives, memory = model.pruning_state["peak"], peak_memory(model.device) / 1e6
    CONSOLE.log(f"peak: {primitives:,} primitives, {memory:,.0f} MB of {model.device.type} memory")
    writer.put_dict(name="Peak", scalar_dict={"primitives": primitives, "memory_mb": memory}, step=step)
    if model.budget is not None:
        model.budget.finish(model, attributes)
    else:
        warn_if_too_short(model, step)
    writer.write_out_storage()


def refresh(model: SundaeModel, optimizers: Optimizers) -> None:
    """Surgery makes new parameters; nerfstudio's own list of them would go stale."""
    for name, value in model.gauss_params.items():
        optimizers.parameters[name] = [value]


def record(
    model: SundaeModel,
    attributes: TrainingCallbackAttributes,
    report: PruneReport,
    step: int,
    *,
    before: dict[str, float],
    after: dict[str, float],
) -> None:
    """Write what the prune did to tensorboard, and to ``prune.json`` in the run's folder.

    Args:
        model: the model.
        attributes: of the callback.
        report: what the prune did.
        step: of training.
        before, after: metrics of the test views on both sides of it; empty where they were not looked at.
    """
    scalars = {"before": report.before, "after": report.after, "seconds": report.seconds, "peak": report.peak}
    writer.put_dict(name="Prune", scalar_dict=scalars, step=step)
    if attributes.trainer is not None and (model.shards is None or model.shards.rank == 0):
        _append(attributes.trainer.base_dir / "prune.json", report, before, after)


def _append(path: Path, report: PruneReport, before: dict[str, float], after: dict[str, float]) -> None:
    # A run that was killed after a prune and before the next save does that prune again.
    reports = prunes_before(path, report.step)
    reports.append({**asdict(report), "warm_up": before, "pruned": after})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(reports, indent=2))


def _evaluate(model: SundaeModel, pipeline: Any, label: str, step: int) -> dict[str, float]:
    if not pipeline.datamanager.eval_dataset:
        return {}
    if model.shards is not None:
        model.shards.agree_on_focal(model)
    results = pipeline.get_average_eval_image_metrics(step=step)
    CONSOLE.log(f"{label}: PSNR {results['psnr']:.2f} dB, SSIM {results['ssim']:.4f} on all test views")
    return {name: results[name] for name in ("psnr", "ssim")}
