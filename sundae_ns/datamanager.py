"""nerfstudio's full-image datamanager, with what SUNDAE needs and the stock one lacks."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio
from nerfstudio.data.datasets.base_dataset import InputDataset
from torch import Tensor

from sundae_ns.errors import ConfigError, DataError
from sundae_ns.storage.point_cloud import read_point_cloud

DATASET_FRAME = "sundae_dataset_frame"
"""Key of the training set's metadata: (transform ``[3, 4]``, scale) from the capture's own coordinates to the model's."""


class LightNerfstudioParser(Nerfstudio):
    """The ``nerfstudio-data`` parser, reading sparse clouds without open3d, which needs system libraries of a desktop."""

    def _load_3D_points(
        self, ply_file_path: Path, transform_matrix: Tensor, scale_factor: float
    ) -> dict[str, Tensor] | None:
        if not ply_file_path.exists():
            raise DataError(f"{ply_file_path} does not exist; mend ply_file_path in transforms.json, or remove it")
        points, rgb = read_point_cloud(ply_file_path)
        if len(points) == 0:
            return None
        moved = (points @ transform_matrix[:3, :3].T + transform_matrix[:3, 3]) * scale_factor
        return {"points3D_xyz": moved, "points3D_rgb": rgb}


@dataclass
class SundaeDatamanagerConfig(FullImageDatamanagerConfig):
    """Full images, in an order that depends on nothing but the seed and the step."""

    _target: type = field(default_factory=lambda: SundaeDatamanager)
    holdout_every: int = 0
    """Hold back every n-th training view from training, for choosing budgets without touching test views. 0: none."""


class SundaeDatamanager(FullImageDatamanager[InputDataset]):
    """Serves whole images.

    Beyond the stock datamanager: it caches images on machines without CUDA; the view of a step is a function of seed and
    step, so that a resumed run continues the same order; it can hold back training views; and it lists the training
    cameras for the pass that measures each primitive's contribution. Training cameras stay on the CPU, where reading
    their sizes does not wait for the GPU.
    """

    config: SundaeDatamanagerConfig

    def __init__(self, config: SundaeDatamanagerConfig, *args: Any, **kwargs: Any) -> None:
        if config.train_cameras_sampling_strategy != "random":
            raise ConfigError(
                "train-cameras-sampling-strategy fps is not a function of seed and step, so a resumed run could not "
                "continue it; use random"
            )
        if config.holdout_every < 0 or config.holdout_every == 1:
            raise ConfigError(f"holdout-every is {config.holdout_every}; give 0 (none) or at least 2")
        if config.dataparser._target is Nerfstudio:
            config.dataparser._target = LightNerfstudioParser
        super().__init__(config, *args, **kwargs)
        self._order: tuple[int, list[int]] = (-1, [])

    def create_train_dataset(self) -> InputDataset:
        """The training set, with the transform from the capture's frame to the model's in its metadata."""
        outputs = self.train_dataparser_outputs
        if len(outputs.image_filenames) == 0:
            raise DataError(f"no training images in {self.config.dataparser.data}; check the path and the split")
        outputs.metadata[DATASET_FRAME] = (outputs.dataparser_transform, float(outputs.dataparser_scale))
        return super().create_train_dataset()

    @property
    def holdout_indices(self) -> list[int]:
        """Training views that are held back."""
        every = self.config.holdout_every
        return list(range(every - 1, len(self.train_dataset), every)) if every else []

    @property
    def train_indices(self) -> list[int]:
        """Training views that training sees."""
        held_back = set(self.holdout_indices)
        return [i for i in range(len(self.train_dataset)) if i not in held_back]

    def view_of_step(self, step: int) -> int:
        """Index of the training view of ``step``: each pass over the views is a new permutation."""
        indices = self.train_indices
        epoch, position = divmod(step, len(indices))
        if self._order[0] != epoch:
            random.Random(f"{self.config.train_cameras_sampling_seed}-{epoch}").shuffle(indices)
            self._order = (epoch, indices)
        return self._order[1][position]

    def training_cameras(self) -> Iterator[Cameras]:
        """Every training camera that is not held back, on the CPU, each of shape ``(1,)``."""
        for index in self.train_indices:
            yield self.train_dataset.cameras[index : index + 1]

    @property
    def holdout_views(self) -> list[tuple[Cameras, dict[str, torch.Tensor]]]:
        """Held-back views as (camera, batch) pairs, in the form that nerfstudio's evaluation takes."""
        return [self._view(index) for index in self.holdout_indices]

    def _view(self, index: int) -> tuple[Cameras, dict[str, torch.Tensor]]:
        batch = dict(self.cached_train[index])
        batch["image"] = batch["image"].to(self.device)
        camera = self.train_dataset.cameras[index : index + 1]
        camera.metadata = {**(camera.metadata or {}), "cam_idx": index}
        return camera, batch

    def next_train(self, step: int) -> tuple[Cameras, dict[str, torch.Tensor]]:
        """Camera (on the CPU) and batch of ``step``."""
        return self._view(self.view_of_step(step))

    def _load_images(
        self, split: Literal["train", "eval"], cache_images_device: Literal["cpu", "gpu"]
    ) -> list[dict[str, torch.Tensor]]:
        dataset = self.train_dataset if split == "train" else self.eval_dataset
        self._check_sizes(dataset)
        if cache_images_device == "cpu" and not torch.cuda.is_available():
            # The stock code pins the memory of "cpu" caches, which needs a driver; "gpu" means the model's device.
            cache_images_device = "gpu"
        return super()._load_images(split, cache_images_device)

    def _check_sizes(self, dataset: InputDataset) -> None:
        from PIL import Image

        scale = dataset.scale_factor
        for index, path in enumerate(dataset.image_filenames):
            with Image.open(path) as image:
                size = tuple(int(side * scale) for side in image.size)
            camera = dataset.cameras[index]
            expected = (int(camera.width.item()), int(camera.height.item()))
            if size != expected:
                raise DataError(
                    f"{path.name} is {size[0]} x {size[1]} px but its camera says {expected[0]} x {expected[1]}; "
                    "give each size its own camera, or resize the images"
                )
