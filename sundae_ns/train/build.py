"""The parts of a model, built from its options: parameters, networks, state and callbacks."""

from __future__ import annotations

import math
from typing import Any, cast

import torch

from sundae_ns.core.errors import ConfigError
from sundae_ns.core.gaussians import MAX_SH_DEGREE, Gaussians
from sundae_ns.head.head import CompensationHead
from sundae_ns.train.averaging import Averaging
from sundae_ns.train.densification import Densification, make_strategy
from sundae_ns.train.exposure import ExposureCompensation
from sundae_ns.train.initialize import DenseStart, Frame, Points, Start, initial_gaussians
from sundae_ns.train.pruning import UNPRUNED, FloaterRemoval, ScheduledPruning
from sundae_ns.train.state import Callback, TrainingState
from sundae_ns.train.trials import AfterPrune, Trials

STOCK_ONLY = ("use_bilateral_grid", "use_scale_regularization", "color_corrected_metrics")
"""Options of splatfacto that nothing here reads; a head would learn against what a bilateral grid does."""


def check(options: Any) -> None:
    """Check options that cannot work, alone or together; raises a ConfigError with the first one and its remedy."""
    options.pruning.validate()
    if options.head.mode != "off":
        options.head.validate()
    for names, least, most, remedy in (
        (("base_loss_weight", "prior_after_prune", "dense_start_views"), 0, math.inf, "0 or more"),
        (("num_random", "refine_every", "reset_alpha_every", "resolution_schedule"), 1, math.inf, "1 or more"),
        (("average_share",), 0, 1, "a share of the schedule, 0.1 for the last tenth"),
        (("drop_rate",), 0, 0.9, "a share of the Gaussians, 0.2 for few photos"),
        (("ssim_lambda",), 0, 1, "a share of the loss, 0.2 for the usual one"),
        (("sh_degree",), 0, MAX_SH_DEGREE, f"0 to {MAX_SH_DEGREE}"),
        (STOCK_ONLY, 0, 0, "False: only splatfacto has it"),
    ):
        for name in names:
            value = getattr(options, name)
            if value is not None and not least <= value <= most:
                raise ConfigError(f"{name.replace('_', '-')} is {value}; give {remedy}")
    if options.warm_start is not None and options.pruning.mode == "continuous":
        raise ConfigError("a warm start is pruned at once, not while it grows: set pruning.mode to one-shot")


def build(
    options: Any, num_images: int, points: Points | None, frame: Frame | None
) -> tuple[TrainingState, list[Callback], Start]:
    """Build the parts on the CPU, by the ``options`` of a ``SundaeModelConfig``; ``ConfigError`` if one cannot work.

    ``points`` are the sparse ones of a capture of ``num_images``, if it has any; ``frame`` leads from its coordinates
    to the model's, if known. Returns the state of Gaussians and head; callbacks in their order; what to announce at the
    start.
    """
    check(options)
    pruning, head = options.pruning, options.head.resolved
    warm = options.warm_start is not None
    strategy = make_strategy(options, num_images)
    params, start = initial_gaussians(options, points, frame)
    gauss_params = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in params.items()})
    state = TrainingState(
        gaussians=Gaussians(cast(Any, gauss_params), "logits" if options.sh_degree == 0 else "harmonics"),
        networks=torch.nn.ModuleDict({} if head.mode == "off" else {"head": CompensationHead(head)}),
        pruning=dict(UNPRUNED),
        offset=pruning.prune_at if warm else 0,
        densify_until=strategy.refine_stop_iter,
        head_starts_at=pruning.settled_at if head.start_at is None else head.start_at,
        sh_degree_interval=None if warm else options.sh_degree_interval,
    )
    densification = Densification(strategy)
    densification.initialize(state)
    begins_at = int(max(state.head_starts_at, pruning.settled_at, state.densify_until))
    trials = Trials(options, state, densification, begins_at)
    train_callbacks: list[Callback] = [
        DenseStart(options, points, num_images),
        densification,
        FloaterRemoval(None if points is None else points[0]),
        trials,  # also where options decide: a run that is resumed may have been in one
        ScheduledPruning(pruning, evaluate=options.evaluate_prune),
        AfterPrune(trials),
        ExposureCompensation(num_images, options.exposure_compensation),
    ]
    if options.average_share > 0:
        train_callbacks.append(Averaging(options.average_share, max(pruning.settled_at, state.densify_until)))
    return state, train_callbacks, start
