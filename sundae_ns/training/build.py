"""The parts of a model, built from its options: parameters, networks, state and extensions."""

from __future__ import annotations

from typing import Any, cast

import torch

from sundae_ns.compensation import CompensationHead
from sundae_ns.errors import ConfigError
from sundae_ns.gaussians.gaussians import Field
from sundae_ns.training.averaging import Averaging
from sundae_ns.training.dense_start import DenseStart
from sundae_ns.training.densification import Densification, make_strategy
from sundae_ns.training.extension import Extension
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.floaters import FloaterRemoval
from sundae_ns.training.initial_field import Frame, Points, Start, initial_field
from sundae_ns.training.options import ModelOptions
from sundae_ns.training.photo_gains import PhotoGains
from sundae_ns.training.pruning import ScheduledPruning
from sundae_ns.training.schedules import PruningSchedule
from sundae_ns.training.trials.count import CountTrials
from sundae_ns.training.trials.engine import TrialEngine
from sundae_ns.training.trials.head import HeadTrials
from sundae_ns.training.trials.stopping import EarlyStopping


def check(options: ModelOptions) -> None:
    """Check options that cannot work, alone or together.

    Raises:
        ConfigError: the first such option, and its mend.
    """
    options.pruning.validate()
    if options.head.mode != "off":
        options.head.validate()
    for name in ("base_loss_weight", "prior_after_prune"):
        if getattr(options, name) < 0:
            raise ConfigError(f"{name.replace('_', '-')} is {getattr(options, name)}; give 0 or more")
    if options.dense_start_views < 0:
        raise ConfigError(f"dense-start-views is {options.dense_start_views}; give a number of images, 0 for no sweep")
    if not 0 <= options.average_share <= 1:
        raise ConfigError(
            f"average-share is {options.average_share}; give a share of the schedule, 0.1 for the last tenth"
        )
    if options.warm_start is not None and options.pruning.mode == "continuous":
        raise ConfigError("a warm start is pruned at once, not while it grows: set pruning.mode to one-shot")
    if options.use_bilateral_grid:
        raise ConfigError("sundae has no bilateral grid: the head would learn against it; use splatfacto for it")


def build(
    options: ModelOptions, num_images: int, points: Points | None, frame: Frame | None
) -> tuple[FieldState, list[Extension], Start]:
    """Build the parts on the CPU.

    Args:
        options: of the model.
        num_images: number of training images.
        points: sparse points of the capture, if it has any.
        frame: transform from the capture's coordinates to the model's, if known.

    Returns:
        State of field and head; extensions in their order (dense start, densification, removal of floaters, trials of
        counts, scheduled pruning, trials of the head and stopping, gains of the photos, averaging; trials and
        averaging optional); what to announce when training starts.

    Raises:
        ConfigError: an option cannot work.
    """
    check(options)
    pruning, head, warm = options.pruning, options.head.resolved, options.warm_start is not None
    strategy, num_features = make_strategy(options, num_images), 0 if head.mode == "off" else head.num_features
    params, start = initial_field(options, points, frame, num_features=num_features, cap=strategy.cap)
    gauss_params = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in params.items()})
    networks = torch.nn.ModuleDict({} if head.mode == "off" else {"head": CompensationHead(head)})
    state = FieldState(
        field=Field(cast(Any, gauss_params), "logits" if options.sh_degree == 0 else "harmonics"),
        networks=networks,
        offset=pruning.prune_at if warm else 0,
        densify_until=strategy.refine_stop_iter,
        head_starts_at=pruning.settled_at if head.start_at is None else head.start_at,
        sh_degree_interval=None if warm else options.sh_degree_interval,
    )
    densification, schedule = Densification(strategy), PruningSchedule(pruning)
    densification.initialize(state)
    state.pruning = schedule.initialize_state()
    begins_at = int(max(state.head_starts_at, pruning.settled_at, state.densify_until))
    engine = TrialEngine(begins_at)
    removal = FloaterRemoval(None if points is None else points[0])
    dense = DenseStart(options, points, num_images, num_features=num_features, cap=strategy.cap)
    extensions: list[Extension] = [dense, densification, removal]
    counts = CountTrials(pruning, densification, engine, alone=options.head.mode != "auto") if pruning.decides else None
    extensions += [] if counts is None else [counts]
    extensions.append(ScheduledPruning(schedule, evaluate=options.evaluate_prune))
    if options.head.mode == "auto":
        decision = HeadTrials(begins_at, state, engine, None if counts is None else counts.head_pays)
        extensions += [decision, EarlyStopping(decision, options.ssim_lambda, engine)]
    extensions.append(PhotoGains(num_images, options.photo_gains))
    if options.average_share > 0:
        extensions.append(Averaging(options.average_share, max(pruning.settled_at, state.densify_until)))
    return state, extensions, start
