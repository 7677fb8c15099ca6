"""The field that a training starts from: sparse points of the capture, random points, or a finished field.

Structure from motion finds points where it can tell one from another: a few hundred in a dozen photos, few on lawns and
walls. There, :class:`DenseStart` adds points by a plane sweep through the images. Where a field begins without any, it
explains each image by Gaussians near its camera, and other views do not agree.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rich.progress import track
from torch import Tensor

from sundae_ns.core.errors import CheckpointError, PackError
from sundae_ns.core.gaussians import FEATURES, rgb_to_logit, sh_to_rgb
from sundae_ns.core.surgery import replace_parameter
from sundae_ns.io.coordinates import similarity
from sundae_ns.io.formats import kind_of, read_gaussians
from sundae_ns.pruning.selection import neighbor_order, select_systematic
from sundae_ns.scene.scene import from_points, initial_features
from sundae_ns.scene.virtual_cameras import by_device
from sundae_ns.train.plane_sweep import Sweep
from sundae_ns.train.state import Callback, TrainingRun, TrainingState

_log = logging.getLogger(__name__)

FEWEST_POINTS = 50  # With fewer sparse points a user hears that photos overlap too little
SIDES = {"cuda": 640, "cpu": 160}  # Longest side of the swept images, pixels; a CPU takes a second a view
MOST_ON_CPU = 24  # Most views that a CPU sweeps
FILLED = {"cuda": 100_000, "cpu": 20_000}  # Points up to which a sparse cloud is filled; a larger one is not
Points = tuple[Tensor, Tensor]  # Positions [N, 3] and colours in 0 to 255 [N, 3]
Frame = tuple[Tensor, float]  # Transform [3, 4] and scale from the capture's coordinates to those of the model


@dataclass(frozen=True)
class Start:
    """Warnings or an error to report when training starts. A checkpoint that is loaded first makes them irrelevant."""

    warnings: tuple[str, ...] = ()
    failure: CheckpointError | PackError | None = None  # Why the model could not start from its warm start

    def announce(self) -> None:
        """Log the warnings, or raise the failure."""
        if self.failure is not None:
            raise self.failure
        for warning in self.warnings:
            _log.warning(warning)


def initial_gaussians(options: Any, points: Points | None, frame: Frame | None) -> tuple[dict[str, Tensor], Start]:
    """Parameters of a new model, float32 on the CPU, and what to report if it is trained; arguments as for ``build``.

    A finished run must open without the file that it started from. The field then comes from the sparse points, and the
    error is reported only when training starts.
    """
    try:
        if options.warm_start is None:
            params, start = _sparse_gaussians(options, points)
        else:
            params, start = _warm_gaussians(options, options.warm_start, frame), Start()
    except (CheckpointError, PackError) as error:
        params, start = _sparse_gaussians(options, points)[0], Start(failure=error)
    if options.num_features:
        params[FEATURES] = initial_features(params["features_dc"], options.num_features)
    if options.sh_degree == 0:
        # splatfacto and nerfstudio's exporter store logits of colours at SH degree 0.
        params["features_dc"] = rgb_to_logit(sh_to_rgb(params["features_dc"]))
    return params, start


def _sparse_gaussians(options: Any, points: Points | None) -> tuple[dict[str, Tensor], Start]:
    warnings: list[str] = []
    cap = options.pruning.cap
    if points is not None and len(points[0]) > 0 and not options.random_init:
        xyz, colours = points
        rgb = colours.float() / 255 if len(colours) else torch.full_like(xyz, 0.5)
        if len(xyz) < FEWEST_POINTS:
            few = "its photos hardly overlap and the scene will be poor; add photos between them"
            warnings.append(f"the capture has only {len(xyz)} sparse points: {few}")
    else:
        if not options.random_init:
            none = f"the capture has no sparse point cloud; starting from {options.num_random} random points"
            warnings.append(f"{none}. Results are better with one (COLMAP, or ply_file_path in transforms.json).")
        xyz = (torch.rand(options.num_random, 3) - 0.5) * options.random_scale
        rgb = torch.rand_like(xyz)
    if cap is not None and len(xyz) > cap:
        warnings.append(f"{len(xyz):,} points are more than the cap; starting from {cap:,} of them")
        chosen = torch.randperm(len(xyz), generator=torch.Generator().manual_seed(options.pruning.seed))[:cap]
        xyz, rgb = xyz[chosen], rgb[chosen]
    return from_points(xyz, rgb, sh_degree=options.sh_degree), Start(tuple(warnings))


def _warm_gaussians(options: Any, source: Path, frame: Frame | None) -> dict[str, Tensor]:
    params, in_model_frame = read_gaussians(source)
    if options.warm_start_frame != "auto":
        in_model_frame = options.warm_start_frame == "model"
    elif kind_of(source) == "gsplat":
        turned = f"{source} does not state its coordinates, which gsplat changes without --no-normalize-world-space"
        raise CheckpointError(f"{turned}; if it had that, give --pipeline.model.warm-start-frame capture")
    if not in_model_frame:
        if frame is None:
            unknown = "the warm start is in the capture's coordinates, and only sundae's datamanager can convert them"
            raise CheckpointError(f"{unknown}; train with it, or give --pipeline.model.warm-start-frame model")
        params = similarity(params, *frame)
        params["means"] = params["means"].float()  # survey coordinates are float64 until here
    columns = (options.sh_degree + 1) ** 2 - 1
    rest = params["features_rest"][:, :columns]
    params["features_rest"] = torch.cat([rest, rest.new_zeros(len(rest), columns - rest.shape[1], 3)], dim=1)
    _log.info(f"warm start: {len(params['means'])} Gaussians from {source}")
    return params


class DenseStart(Callback):
    """Begins the training anew from sparse and dense points, before the first step; see :func:`initial_gaussians`."""

    name = "dense-start"

    def __init__(self, options: Any, points: Points | None, num_images: int) -> None:
        self._options = options
        wanted = 2 <= num_images <= options.dense_start_views and options.warm_start is None and not options.random_init
        self._points = points if wanted and points is not None and len(points[0]) else None  # of a start to come

    def load_state_dict(self, state: TrainingState, saved: Mapping[str, Any]) -> None:
        """A field of a checkpoint is in training."""
        self._points = None

    def before_training(self, run: TrainingRun) -> None:
        """Sweep, and put the larger field in the place of the one from sparse points."""
        if self._points is None:
            return
        sparse, colours = self._points
        self._points = None
        state = run.state
        most = by_device(FILLED, state.device) - len(sparse)
        too_slow = state.device.type == "cpu" and len(run.view_indices()) > MOST_ON_CPU
        if too_slow or most <= 0:
            return
        on_device = sparse.to(state.device)
        with torch.no_grad():
            sweep = Sweep(run.photos(), on_device[on_device.isfinite().all(dim=1)], by_device(SIDES, state.device))
            for i in track(range(len(sweep.photos)), "Plane sweep", transient=True):
                sweep.add(i)
            xyz, rgb = sweep.points(most)
            if len(xyz) > most:
                even = select_systematic(torch.ones(len(xyz)), most, neighbor_order(xyz), self._options.pruning.seed)
                xyz, rgb = xyz[even.to(xyz.device)], rgb[even.to(rgb.device)]
        colours = colours.float() if len(colours) else torch.full_like(sparse, 127.5)
        points = torch.cat([sparse, xyz.to(sparse)]), torch.cat([colours, 255 * rgb.to(colours)])
        params, _ = initial_gaussians(self._options, points, None)
        for name, value in params.items():  # without moments
            replace_parameter(state.gaussians.data, state.optimizers, name, value.to(state.device), {})
        without = "--pipeline.model.dense-start-views 0 leaves them out"
        _log.info(f"{len(xyz):,} points by a plane sweep beside {len(sparse):,} sparse ones ({without})")
