"""The extension that gives a field more points to start from, by a plane sweep through its images.

Structure from motion finds points where it can tell one from another: a few hundred in a dozen photos, few on lawns and
walls. Where a field begins without any, it explains each image by primitives near its camera, and other views do not
agree.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import track
from torch import Tensor

from sundae_ns.api.virtual import by_device
from sundae_ns.gaussians.surgery import replace_parameter
from sundae_ns.pruning.selection import neighbor_order, select_systematic
from sundae_ns.training.extension import Extension, TrainingRun
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.initial_field import Points, initial_field
from sundae_ns.training.options import ModelOptions
from sundae_ns.training.plane_sweep import Sweep

SIDES = {"cuda": 640, "cpu": 160}
"""Longest side of the swept images, pixels, by device: a CPU takes a second a view, a GPU a fraction."""
MOST_ON_CPU = 24
"""Most views that a CPU sweeps."""
FILLED = {"cuda": 100_000, "cpu": 20_000}
"""Number of points up to which a sparse cloud is filled; a larger one stays as it is."""


class DenseStart(Extension):
    """Begins the training anew from sparse and dense points, before the first step.

    Args:
        options: of the model.
        points: sparse points of the capture; None or none at all leave the field as it is.
        num_images: number of training images.
        num_features: length of the feature vectors; 0 for none.
        cap: highest number of primitives to start with; None for no cap.
    """

    name = "dense-start"

    def __init__(
        self, options: ModelOptions, points: Points | None, num_images: int, *, num_features: int, cap: int | None
    ) -> None:
        self._options, self._points, self._num_features, self._cap = options, points, num_features, cap
        wanted = 2 <= num_images <= options.dense_start_views and options.warm_start is None and not options.random_init
        self._done = not wanted or points is None or len(points[0]) == 0

    def state_dict(self) -> dict[str, Any]:
        """Nothing: a checkpoint holds the field that has begun."""
        return {}

    def load_state_dict(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """A field of a checkpoint is in training."""
        self._done = True

    def before_training(self, run: TrainingRun) -> None:
        """Sweep, and put the larger field in the place of the one from sparse points."""
        if self._done:
            return
        self._done = True
        assert self._points is not None
        state, (sparse, colours) = run.state, self._points
        too_many = state.device.type == "cpu" and len(run.view_indices()) > MOST_ON_CPU
        if too_many or len(sparse) >= by_device(FILLED, state.device):
            return
        xyz, rgb = self._swept(run, sparse.to(state.device))
        colours = colours.float()
        colours = colours if len(colours) else torch.full_like(sparse, 127.5)
        points = torch.cat([sparse, xyz.to(sparse)]), torch.cat([colours, 255 * rgb.to(colours)])
        params, _ = initial_field(self._options, points, None, num_features=self._num_features, cap=self._cap)
        for name, value in params.items():  # without moments
            replace_parameter(state.field.data, state.optimizers, name, value.to(state.device), {})
        CONSOLE.log(
            f"{len(xyz):,} points by a plane sweep beside {len(sparse):,} sparse ones "
            "(--pipeline.model.dense-start-views 0 leaves them out)"
        )

    @torch.no_grad()
    def _swept(self, run: TrainingRun, sparse: Tensor) -> Points:
        """Positions ``[N, 3]`` and colours in [0, 1] ``[N, 3]``; evenly spread ones if too many are found."""
        most = by_device(FILLED, run.state.device) - len(sparse)
        sweep = Sweep(run.photos(), sparse[sparse.isfinite().all(dim=1)], by_device(SIDES, run.state.device))
        for i in track(range(len(sweep.photos)), "Plane sweep", transient=True, console=CONSOLE):
            sweep.add(i)
        xyz, rgb = sweep.points(most)
        if len(xyz) > most:
            even = select_systematic(torch.ones(len(xyz)), most, neighbor_order(xyz), self._options.pruning.seed)
            xyz, rgb = xyz[even.to(xyz.device)], rgb[even.to(rgb.device)]
        return xyz.cpu(), rgb.cpu()
