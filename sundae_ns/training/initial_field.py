"""The field that a model starts from: sparse points of the capture, random points, or a finished field."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sundae_ns.errors import CheckpointError
from sundae_ns.gaussians import FEATURES, from_points, initial_features, random_points
from sundae_ns.gaussians.gaussians import rgb_to_logit, sh_to_rgb
from sundae_ns.storage.coordinates import similarity
from sundae_ns.storage.formats import kind_of, read_field
from sundae_ns.training.options import ModelOptions
from sundae_ns.training.warning import warn

FEWEST_POINTS = 50
"""With fewer sparse points a user hears that photos overlap too little."""

Points = tuple[Tensor, Tensor]
"""Positions ``[N, 3]`` and colours in 0 to 255 ``[N, 3]``."""

Frame = tuple[Tensor, float]
"""Transform ``[3, 4]`` and scale from the capture's coordinates to those of the model."""


@dataclass(frozen=True)
class Start:
    """Warnings or an error to report when training starts. A checkpoint that is loaded first makes them irrelevant."""

    warnings: tuple[str, ...] = ()
    failure: CheckpointError | None = None
    """Why the model could not start from its warm start."""

    def announce(self) -> None:
        """Print the warnings.

        Raises:
            CheckpointError: the failure.
        """
        if self.failure is not None:
            raise self.failure
        for warning in self.warnings:
            warn(warning)


def initial_field(
    options: ModelOptions, points: Points | None, frame: Frame | None, *, num_features: int, cap: int | None
) -> tuple[dict[str, Tensor], Start]:
    """Parameters of a new model, float32 on the CPU, and what to report if it is trained.

    A finished run must open without the file that it started from. The field then comes from the sparse points, and the
    error is reported only when training starts.

    Args:
        options: of the model.
        points: sparse points of the capture, if it has any.
        frame: of the capture, if known.
        num_features: length of the feature vectors; 0 for none.
        cap: highest number of primitives to start with; None for no cap.
    """
    start = Start()
    try:
        if options.warm_start is None:
            params, start = _sparse_field(options, points, num_features, cap)
        else:
            params = _warm_field(options, options.warm_start, frame, num_features)
    except CheckpointError as error:
        params, start = _sparse_field(options, points, num_features, cap)[0], Start(failure=error)
    if options.sh_degree == 0:
        # splatfacto and nerfstudio's exporter store logits of colours at SH degree 0.
        params["features_dc"] = rgb_to_logit(sh_to_rgb(params["features_dc"]))
    return params, start


def _sparse_field(
    options: ModelOptions, points: Points | None, num_features: int, cap: int | None
) -> tuple[dict[str, Tensor], Start]:
    warnings: list[str] = []
    if points is not None and len(points[0]) > 0 and not options.random_init:
        xyz, rgb = points[0], points[1].float() / 255 if len(points[1]) else torch.full_like(points[0], 0.5)
        if len(xyz) < FEWEST_POINTS:
            warnings.append(
                f"the capture has only {len(xyz)} sparse points: its photos hardly overlap and the scene will be poor; "
                "add photos between them"
            )
    else:
        if not options.random_init:
            warnings.append(
                f"the capture has no sparse point cloud; starting from {options.num_random} random points. Results are "
                "better with one (COLMAP, or ply_file_path in transforms.json)."
            )
        xyz, rgb = random_points(options.num_random, options.random_scale)
    if cap is not None and len(xyz) > cap:
        warnings.append(f"{len(xyz):,} points are more than the cap; starting from {cap:,} of them")
        chosen = torch.randperm(len(xyz), generator=torch.Generator().manual_seed(options.pruning.seed))[:cap]
        xyz, rgb = xyz[chosen], rgb[chosen]
    params = from_points(xyz, rgb, sh_degree=options.sh_degree, num_features=num_features)
    return params, Start(tuple(warnings))


def _warm_field(options: ModelOptions, source: Path, frame: Frame | None, num_features: int) -> dict[str, Tensor]:
    params, in_model_frame, _ = read_field(source)
    if options.warm_start_frame != "auto":
        in_model_frame = options.warm_start_frame == "model"
    elif kind_of(source) == "gsplat":
        raise CheckpointError(
            f"{source} does not state its coordinates, and gsplat turns and scales a capture unless it trains with "
            "--no-normalize-world-space; if it did, give --pipeline.model.warm-start-frame capture"
        )
    if not in_model_frame:
        if frame is None:
            raise CheckpointError(
                "the warm start is in the capture's coordinates, and only sundae's datamanager knows their transform; "
                "train with it, or give --pipeline.model.warm-start-frame model"
            )
        params = similarity(params, *frame)
    wanted, found = (options.sh_degree + 1) ** 2 - 1, params["features_rest"].shape[1]
    rest = params["features_rest"].new_zeros(len(params["means"]), wanted, 3)
    rest[:, : min(wanted, found)] = params["features_rest"][:, : min(wanted, found)]
    params["features_rest"] = rest
    if num_features:
        params[FEATURES] = initial_features(params["features_dc"], num_features)
    CONSOLE.log(f"warm start: {len(params['means'])} primitives from {source}")
    return params
