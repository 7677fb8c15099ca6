"""Gains of the photos in training: exposure and white balance in which a photo differs from those beside it.

A camera that adjusts itself photographs one wall brighter and darker. A field that has to agree with all of the photos
becomes an average of them, with a haze where they disagree. So each photo is divided by its gain, three numbers, before
it is compared. Test views and finished scenes have no gains.

What neighbouring photos share may come from the place, such as light from a window, and a field can show that by
itself. Left in the gains it would be lost for every other view. So a gain is a high-pass response on the graph of the
cameras: what its neighbours do not have.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.filters import Smoother
from sundae_ns.graphs import build_graph
from sundae_ns.rasterization.projection import camera_center
from sundae_ns.rendering.views import View
from sundae_ns.training.extension import Extension, TrainingRun
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.warning import warn

NEIGHBORS = 8
"""Cameras with which one is compared."""
SMOOTHING = 8.0
"""Strength of the filter that finds what neighbours have in common."""
NOISE = 0.03
"""Relative differences between neighbours that a field's own errors make: 1 to 3% where the light does not change."""
LEAST_PHOTOS = 32
"""With fewer photos, neighbours are too far apart to be compared."""
MEASURED_EVERY = 2
"""Steps between two measurements, which take some small kernels each."""
REFRESHED_EVERY = 200
"""Steps between two updates, each of which waits for the GPU."""
NEWEST_WEIGHT = 0.3
"""Weight of a new measurement of a photo beside its earlier ones; the field changes while they are taken."""
MOST = 4.0
"""Largest factor between a photo and its image that counts as a gain."""
CLIPPED = 0.98
"""From this value on a pixel of a photo may be clipped, and says nothing of its gain."""
SAMPLE = 1 << 14
"""About as many pixels of an image are measured."""


class PhotoGains(Extension):
    """Measures the gains of the training photos, and divides photos by them.

    Args:
        num_photos: number of training photos.
    """

    name = "photo-gains"

    def __init__(self, num_photos: int) -> None:
        self._gains = torch.ones(num_photos, 3)
        self._sums = torch.zeros(num_photos, 2, 3)
        """Of photo times image and of squares of the image, by channel, since the last update."""
        self._measured = np.zeros((num_photos, 3))
        """Logarithms of how much brighter a photo is than its image."""
        self._counts = np.zeros(num_photos, np.int64)
        """Updates of each photo."""
        self._rows = np.zeros(0, np.int64)
        """Photos that training sees."""
        self._smoother: Smoother | None = None
        """On their cameras; None without gains."""
        self.total: Callable[[Tensor], Tensor] = lambda sums: sums
        """Adds up the sums of several ranks."""

    def state_dict(self) -> dict[str, Any]:
        """Gains and measurements."""
        measured, counts = torch.from_numpy(self._measured.copy()), torch.from_numpy(self._counts.copy())
        return {"gains": self._gains.clone(), "sums": self._sums.clone(), "measured": measured, "counts": counts}

    def load_state_dict(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Counterpart of :meth:`state_dict`; other photos, or none as in an earlier version, begin anew."""
        if "gains" not in saved or len(saved["gains"]) != len(self._gains):
            return
        self._gains, self._sums = (saved[name].to(state.device, copy=True) for name in ("gains", "sums"))
        self._measured, self._counts = (saved[name].cpu().numpy().copy() for name in ("measured", "counts"))

    def before_training(self, run: TrainingRun) -> None:
        """Build the graph of the cameras."""
        if len(self._gains) == 0:
            return
        indices, views = run.view_indices(), [own.view for own in run.training_views()]
        if len(indices) < LEAST_PHOTOS:
            warn(
                f"photo-gains is off: {len(indices)} training photos are too few to be compared with those beside them"
            )
            return
        self._state, self._rows = run.state, np.asarray(indices)
        self._smoother = Smoother(build_graph(places(views).cpu(), num_neighbors=NEIGHBORS), SMOOTHING)
        if run.images_per_step > 1:  # of the first rank alone
            self._sums.zero_()

    def balanced(self, photo: Tensor, batch: Mapping[str, Any]) -> Tensor:
        """A training photo ``[H, W, 3]`` divided by its gain; those with an alpha channel have none."""
        index = _index(batch)
        if index is None or len(self._gains) == 0:
            return photo
        self._gains = self._gains.to(photo.device)
        return photo / self._gains[index]

    @torch.no_grad()
    def observe(self, image: Tensor, photo: Tensor, mask: Tensor | None, batch: Mapping[str, Any]) -> None:
        """Measure an image of the field and its photo.

        Args:
            image: of the field before its step ``[H, W, 3]``.
            photo: as :meth:`balanced` gave it ``[H, W, 3]``.
            mask: pixels that count ``[H, W, 1]``; None for all.
            batch: of the photo.
        """
        index = _index(batch)
        if index is None or self._smoother is None or self._state.step % MEASURED_EVERY:
            return
        self._sums = self._sums.to(photo.device)
        apart = max(int((photo.shape[0] * photo.shape[1] / SAMPLE) ** 0.5), 1)
        shown, taken = image[::apart, ::apart].detach(), photo[::apart, ::apart] * self._gains[index]
        counts = taken.amax(dim=2, keepdim=True) < CLIPPED
        if mask is not None:
            counts = counts * mask[::apart, ::apart]
        shown = shown * counts
        self._sums[index] += torch.stack([(shown * taken).sum(dim=(0, 1)), (shown * shown).sum(dim=(0, 1))])

    def after_step(self, run: TrainingRun) -> None:
        """Update the gains if it is due."""
        if self._smoother is not None and run.state.step % REFRESHED_EVERY == REFRESHED_EVERY - 1:
            self._update(self.total(self._sums).double().cpu().numpy())
            self._sums.zero_()

    def finish(self, run: TrainingRun) -> None:
        """Say how much the photos differ."""
        if self._smoother is None:
            return
        exposure = self._gains.double().cpu().log().mean(dim=1)
        most = float(exposure.abs().max().exp()) - 1
        CONSOLE.log(
            f"photos are up to {most:.0%} brighter or darker than those beside them; training has taken that out"
            if most > 0
            else "photos are as bright as those beside them; none was changed"
        )

    def _update(self, sums: NDArray[np.float64]) -> None:
        """Count measurements in, and take their smooth part away."""
        assert self._smoother is not None
        products, squares = sums[:, 0], sums[:, 1]
        seen = np.isfinite(sums).all(axis=(1, 2)) & (products > 0).all(axis=1) & (squares > 0).all(axis=1)
        ratio = np.log(products[seen] / squares[seen]).clip(-np.log(MOST), np.log(MOST))
        weight = np.maximum(1 / (self._counts[seen] + 1), NEWEST_WEIGHT)[:, None]
        self._measured[seen] += weight * (ratio - self._measured[seen])
        self._counts[seen] += 1
        rows, known = self._rows, self._counts[self._rows] > 0
        response = (self._measured[rows] - self._smoother(self._measured[rows], known))[known]
        # The positive-part estimator of James and Stein: differences no larger than those of the noise are none.
        response *= max(1 - NOISE**2 / max(float(np.square(response).mean()), NOISE**2), 0.0) if len(response) else 0.0
        self._gains[rows[known]] = torch.from_numpy(np.exp(response)).to(self._gains)


def _index(batch: Mapping[str, Any]) -> int | None:
    """Index of the photo of a batch; None for one that shows a background of a random colour."""
    index = batch.get("image_idx")
    return None if index is None or batch["image"].shape[-1] == 4 else int(index)


def places(views: Sequence[View]) -> Tensor:
    """A point for each camera that is near to those of cameras which see the same, ``[N, 3]``.

    It lies behind the camera, as far as the cameras are from their middle: so those at one place that look elsewhere
    are apart, and so are those around an object.
    """
    centers = torch.stack([camera_center(view.viewmat) for view in views])
    forward = torch.stack([view.viewmat[2, :3] for view in views])
    return centers - (centers - centers.mean(dim=0)).square().sum(dim=1).mean().sqrt() * forward
