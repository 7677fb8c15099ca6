"""The field that a model is built with: from the capture's sparse points, at random, or from a finished field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sundae_ns.datamanager import DATASET_FRAME
from sundae_ns.errors import CheckpointError
from sundae_ns.gaussians import FEATURES, from_points, initial_features, random_points
from sundae_ns.gaussians.parameters import rgb_to_logit, sh_to_rgb
from sundae_ns.pruning import select_random
from sundae_ns.storage.runs import checkpoint
from sundae_ns.storage.transform import similarity
from sundae_ns.training.densification import start_of_chain

if TYPE_CHECKING:
    from sundae_ns.model import SundaeModelConfig

Points = tuple[Tensor, Tensor]
"""Places ``[N, 3]`` and colours in 0 to 255 ``[N, 3]``."""


@dataclass(frozen=True)
class Start:
    """What there is to say of the field that a model is built with, should it be trained: a checkpoint may take its place."""

    warnings: tuple[str, ...] = ()
    failure: CheckpointError | None = None
    """Why the model could not start from where it was told to."""

    def announce(self) -> None:
        """Say so, before the first step.

        Raises:
            CheckpointError: the failure.
        """
        if self.failure is not None:
            raise self.failure
        for warning in self.warnings:
            CONSOLE.print(f"[yellow]Warning: {warning}")


def initial_field(
    config: SundaeModelConfig,
    points: Points | None,
    metadata: Mapping[str, Any],
    *,
    num_features: int,
    cap: int | None,
) -> tuple[dict[str, Tensor], Start]:
    """The parameters of a new model, float32 on the CPU, and what is to be said of them if they are trained.

    A finished run must open without what it once started from, so the field is then that of the sparse points.

    Args:
        config: of the model.
        points: the capture's sparse points, if there are any.
        metadata: of the capture.
        num_features: length of the feature vectors; 0 for none.
        cap: most primitives to start with.
    """
    start = Start()
    try:
        if config.warm_start is None:
            params, start = _sparse_field(config, points, num_features, cap)
        else:
            params = _warm_field(config, config.warm_start, metadata, num_features)
    except CheckpointError as error:
        params, start = _sparse_field(config, points, num_features, cap)[0], Start(failure=error)
    if config.sh_degree == 0:
        # splatfacto's models without harmonics, and nerfstudio's exporter, know colours by their logits.
        params["features_dc"] = rgb_to_logit(sh_to_rgb(params["features_dc"]))
    return params, start


def _sparse_field(
    config: SundaeModelConfig, points: Points | None, num_features: int, cap: int | None
) -> tuple[dict[str, Tensor], Start]:
    warnings: list[str] = []
    if points is not None and len(points[0]) > 0 and not config.random_init:
        xyz, rgb = points[0], points[1].float() / 255 if len(points[1]) else torch.full_like(points[0], 0.5)
    else:
        if not config.random_init:
            warnings.append(
                f"the capture has no sparse point cloud; starting from {config.num_random} random points. Results are "
                "better with one (COLMAP, or ply_file_path in transforms.json)."
            )
        xyz, rgb = random_points(config.num_random, config.random_scale)
    if cap is not None and len(xyz) > cap:
        warnings.append(f"{len(xyz):,} points are more than the cap; starting from {cap:,} of them")
        chosen = select_random(len(xyz), cap, config.pruning.seed, xyz.device)
        xyz, rgb = xyz[chosen], rgb[chosen]
    params = from_points(xyz, rgb, sh_degree=config.sh_degree, num_features=num_features)
    return start_of_chain(params) if config.warmup == "mcmc" else params, Start(tuple(warnings))


def _warm_field(
    config: SundaeModelConfig, source: Path, metadata: Mapping[str, Any], num_features: int
) -> dict[str, Tensor]:
    params, in_model_frame = checkpoint.read_field(source)
    if config.warm_start_frame != "auto":
        in_model_frame = config.warm_start_frame == "model"
    if not in_model_frame:
        frame = metadata.get(DATASET_FRAME)
        if frame is None:
            raise CheckpointError(
                "the warm start is in the capture's coordinates, and only the sundae datamanager knows the way from "
                "there; train with its own datamanager, or say --pipeline.model.warm-start-frame model"
            )
        params = similarity(params, *frame)
    wanted, found = (config.sh_degree + 1) ** 2 - 1, params["features_rest"].shape[1]
    rest = params["features_rest"].new_zeros(len(params["means"]), wanted, 3)
    rest[:, : min(wanted, found)] = params["features_rest"][:, : min(wanted, found)]
    params["features_rest"] = rest
    if num_features:
        params[FEATURES] = initial_features(params["features_dc"], num_features)
    CONSOLE.log(f"warm start: {len(params['means'])} primitives from {source}")
    return params
