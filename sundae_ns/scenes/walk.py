"""Every view of a finished scene, rendered beside its photograph."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sundae_ns.evaluation import ComparisonRow
from sundae_ns.scenes.measure import comparison_of
from sundae_ns.scenes.opening import Opened


def largest_view(opened: Opened) -> tuple[int, int]:
    """Largest width and largest height of the training and test views, in pixels."""
    _ = opened.datamanager.cached_train  # undistortion, which comes with loading, changes the cameras
    cameras = [opened.datamanager.train_dataset.cameras, *opened.cameras]
    return max(int(each.width.max()) for each in cameras), max(int(each.height.max()) for each in cameras)


@torch.no_grad()
def walk(opened: Opened) -> Iterator[ComparisonRow]:
    """Render the views in the order of their file names; titles name the file, and whether it was held out for test.

    Raises:
        DataError: an image cannot be decoded.
    """
    model, manager = opened.model, opened.datamanager
    background = model._get_background_color()

    def training_view(index: int) -> tuple[Cameras, Tensor]:
        image = model.get_gt_img(manager.cached_train[index]["image"].to(model.device))
        # After its image, whose undistortion changes the camera.
        camera = manager.train_dataset.cameras[index : index + 1].to(model.device)
        return camera, model.composite_with_background(image, background)

    order = sorted(
        (path, held_out, index)
        for held_out, dataset in enumerate((manager.train_dataset, manager.eval_dataset))
        for index, path in enumerate(dataset.image_filenames)
    )
    for path, held_out, index in order:
        camera, truth = (opened.cameras[index], opened.truths[index]) if held_out else training_view(index)
        yield comparison_of(model, camera, truth, f"{path.name}, {'test' if held_out else 'training'} view")
