"""Gains of the training photos: differences in exposure and white balance between neighbouring photos.

A camera with automatic exposure photographs one wall in different brightness. A field that fits all of these photos
shows their average, and haze where they disagree. So the loss compares each photo after a division by its gain, one
number a channel. Test views and finished scenes have no gains. Where neighbouring photos agree, there are none either.

Light that neighbouring photos share may belong to the place, as beside a window. A field can show it, and a gain would
remove it from every other view. So a gain is a high-pass response on the graph of the cameras.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.graph.filters import Smoother
from sundae_ns.graph.graph import build_graph
from sundae_ns.train.state import Callback, TrainingRun, TrainingState

_log = logging.getLogger(__name__)

NEIGHBORS = 8  # Neighbours of a camera in the graph
SMOOTHING = 8.0  # Strength of the filter that computes the smooth part of the gains
NOISE = 0.03  # Relative differences between neighbours by errors of the Gaussians, where the light is constant
NOTICED = 0.035  # "auto" divides photos if half of them differ by more (root mean square of the channels)
FIRST_STEPS, FIRST_MEASUREMENTS = 1500, 2  # Steps, and measurements of a photo in the mean, before that decision
LEAST_PHOTOS = 32  # The neighbours of fewer photos are too far apart
MEASURED_EVERY = 2  # Steps between two measurements, which launch some ten small kernels
REFRESHED_EVERY = 200  # Steps between two updates, which wait for the GPU
NEWEST_WEIGHT = 0.3  # Weight of a new measurement in the mean of a photo
LARGEST_FACTOR = 4.0  # Largest measured factor between a photo and its image
CLIPPED = 0.98  # Pixels of a photo from this value on may be clipped, and are not measured
SAMPLE = 1 << 14  # Approximate number of measured pixels of an image


class ExposureCompensation(Callback):
    """Measures the gains of photos, and divides photos by them; ``auto`` decides once they are measured."""

    name = "exposure-compensation"

    def __init__(self, num_photos: int, mode: Literal["auto", "on", "off"]) -> None:
        self._mode = mode
        self._divides = None if mode == "auto" else mode == "on"  # photos by their gains; None if not decided
        self._gains = torch.ones(num_photos, 3, dtype=torch.float32)
        self._sums = torch.zeros(num_photos, 2, 3, dtype=torch.float32)  # Photo x image, squares of the image
        self._measured = np.zeros((num_photos, 3))  # Logarithms of the brightness of a photo over that of its image
        self._counts = np.zeros(num_photos, np.int64)  # Updates of each photo
        self._rows = np.zeros(0, np.int64)  # Indices of the training photos
        self._smoother: Smoother | None = None  # Filter on the graph of their cameras; None if nothing is measured
        self.total: Callable[[Tensor], Tensor] = lambda sums: sums  # Adds up the sums of several ranks

    def state_dict(self) -> dict[str, Any]:
        """Decision, gains and measurements."""
        tensors = {"gains": self._gains, "sums": self._sums}
        tensors |= {"measured": torch.from_numpy(self._measured), "counts": torch.from_numpy(self._counts)}
        return {"divides": self._divides, **{name: value.clone() for name, value in tensors.items()}}

    def load_state_dict(self, state: TrainingState, saved: Mapping[str, Any]) -> None:
        """Counterpart of :meth:`state_dict`; other photos begin anew."""
        if len(saved.get("gains", ())) != len(self._gains):
            return
        if self._mode == "auto":
            self._divides = saved["divides"]
        self._gains, self._sums = (saved[name].to(state.device, copy=True) for name in ("gains", "sums"))
        self._measured, self._counts = (saved[name].cpu().numpy().copy() for name in ("measured", "counts"))

    def before_training(self, run: TrainingRun) -> None:
        """Build the graph of the cameras."""
        if self._divides is False:
            return
        indices = run.view_indices()
        if len(indices) < LEAST_PHOTOS:
            self._divides = False
            if self._mode == "on":
                few = "training photos are too few to be compared with those beside them"
                _log.warning(f"exposure-compensation is off: {len(indices)} {few}")
            return
        self._state, self._rows = run.state, np.asarray(indices)
        positions = view_points([camera for camera, _ in run.training_views()]).cpu()
        self._smoother = Smoother(build_graph(positions, num_neighbors=NEIGHBORS), SMOOTHING)
        self._sums, self._gains = self._sums.to(run.state.device), self._gains.to(run.state.device)
        if run.images_per_step > 1:  # of the first rank alone
            self._sums.zero_()

    def balanced(self, photo: Tensor, batch: Mapping[str, Any]) -> Tensor:
        """A training photo ``[H, W, 3]``, once gains are in use divided by its own; not one with an alpha channel."""
        if (index := _index(batch)) is None or not self._divides:
            return photo
        self._gains = self._gains.to(photo.device)
        return photo / self._gains[index]

    @torch.no_grad()
    def observe(self, image: Tensor, photo: Tensor, mask: Tensor | None, batch: Mapping[str, Any]) -> None:
        """Measure an image before its step ``[H, W, 3]`` and its photo, as :meth:`balanced` gave it ``[H, W, 3]``.

        A mask ``[H, W, 1]`` has the pixels that count; None for all.
        """
        if (index := _index(batch)) is None or self._smoother is None or self._state.step % MEASURED_EVERY:
            return
        apart = max(int((photo.shape[0] * photo.shape[1] / SAMPLE) ** 0.5), 1)
        rendered, taken = image[::apart, ::apart].detach(), photo[::apart, ::apart] * self._gains[index]
        counts = taken.amax(dim=2, keepdim=True) < CLIPPED
        if mask is not None:
            counts = counts * mask[::apart, ::apart]
        rendered = rendered * counts
        self._sums[index] += torch.stack([(rendered * taken).sum(dim=(0, 1)), (rendered * rendered).sum(dim=(0, 1))])

    def after_step(self, run: TrainingRun) -> None:
        """Update the gains if it is due."""
        if self._smoother is not None and run.state.step % REFRESHED_EVERY == REFRESHED_EVERY - 1:
            self._update(self.total(self._sums).double().cpu().numpy())
            self._sums.zero_()

    def finish(self, run: TrainingRun) -> None:
        """Log the largest difference."""
        if self._smoother is None or not self._divides:
            return
        most = float(self._gains.double().cpu().log().mean(dim=1).abs().max().exp()) - 1
        changed = f"up to {most:.0%} brighter or darker than those beside them; training has taken that out"
        _log.info(f"photos are {changed if most > 0 else 'as bright as those beside them; none was changed'}")

    def _update(self, sums: NDArray[np.float64]) -> None:
        """Add measurements to the means, and compute the gains from them."""
        assert self._smoother is not None
        products, squares = sums[:, 0], sums[:, 1]
        valid = np.isfinite(sums).all(axis=(1, 2)) & (products > 0).all(axis=1) & (squares > 0).all(axis=1)
        ratio = np.log(products[valid] / squares[valid]).clip(-np.log(LARGEST_FACTOR), np.log(LARGEST_FACTOR))
        weight = np.maximum(1 / (self._counts[valid] + 1), NEWEST_WEIGHT)[:, None]
        self._measured[valid] += weight * (ratio - self._measured[valid])
        self._counts[valid] += 1
        rows, known = self._rows, self._counts[self._rows] > 0
        response = (self._measured[rows] - self._smoother(self._measured[rows], known))[known]
        ready = self._state.step + 1 >= FIRST_STEPS and self._counts[rows].mean() >= FIRST_MEASUREMENTS
        if self._divides is None and ready:
            self._divides = bool(np.median(np.sqrt(np.square(response).mean(axis=1))) > NOTICED)
            self._smoother = self._smoother if self._divides else None
        if not self._divides:
            return
        # The positive-part estimator of James and Stein; it is 0 up to the size of the noise.
        response *= max(1 - NOISE**2 / max(float(np.square(response).mean()), NOISE**2), 0.0) if len(response) else 0.0
        self._gains[rows[known]] = torch.from_numpy(np.exp(response)).to(self._gains)


def _index(batch: Mapping[str, Any]) -> int | None:
    """Index of the photo of a batch; None for one that shows a background of a random colour."""
    index = batch.get("image_idx")
    return None if index is None or batch["image"].shape[-1] == 4 else int(index)


def view_points(cameras: Sequence[Camera]) -> Tensor:
    """One point for each camera ``[N, 3]``; cameras with similar views have points close together.

    The point lies behind the camera, at the root mean square distance of the cameras to their middle. So two cameras at
    one place with different directions have different points, and so do cameras around an object.
    """
    centers = torch.stack([camera.center for camera in cameras])
    forward = torch.stack([camera.viewmat[2, :3] for camera in cameras])
    return centers - (centers - centers.mean(dim=0)).square().sum(dim=1).mean().sqrt() * forward
