"""nerfstudio's full-image datamanager with checks of the capture, held-out views, and an order that can be resumed."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sundae_ns.data.capture import check_image, check_transforms, no_transforms, undecodable
from sundae_ns.data.colmap import check_colmap
from sundae_ns.errors import ConfigError, DataError, SundaeError, one_line
from sundae_ns.storage import read_point_cloud
from sundae_ns.training.warning import warn

DATASET_FRAME = "sundae_dataset_frame"
"""Metadata key of the training set: transform ``[3, 4]`` and scale from the capture's coordinates to the model's."""

NO_IMAGES = "sundae_no_images"
"""Key of a dataset's metadata and of a batch: cameras without images, which are grey."""

LEAST_FOCAL, MOST_FOCAL = 0.01, 1000.0
"""Shortest and longest focal length in widths of the image: views of 178 and of 0.06 degrees."""
FARTHEST = 10_000
"""Distance of a camera, in median distances, above which its pose is doubted."""


def no_images_error(run: object = "this run") -> DataError:
    """The error for training or evaluating on the grey images of a run that was unpacked without its capture."""
    return DataError(
        f"{run} was unpacked without its capture, so its cameras have no images to train or evaluate on; "
        "give the capture to sundae unpack with --data"
    )


class LightNerfstudioParser(Nerfstudio):
    """The ``nerfstudio-data`` parser without open3d, which needs system libraries of a desktop."""

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


def check_capture(parser: DataParserConfig, data: Path, splits: Sequence[str], *, images: bool = True) -> None:
    """Check a capture in nerfstudio's or COLMAP's layout before its parser reads it.

    Args:
        parser: configuration of the parser; captures of other parsers are not checked.
        data: the capture: a folder, or a ``transforms.json``.
        splits: splits that will be read.
        images: whether the images will be needed; a viewer needs the cameras only.

    Raises:
        DataError: the first thing that cannot be used, and where it stands.
    """
    if not data.exists():
        raise DataError(f"{data} does not exist; give the folder of a capture with --data")
    if isinstance(parser, ColmapDataParserConfig):
        if parser.load_3D_points and not any((data / parser.colmap_path).glob("points3D.*")):
            parser.load_3D_points = False  # the model then warns, and starts from random points
        folder = data / parser.images_path if images else None
        check_colmap(data / parser.colmap_path, folder, points=parser.load_3D_points)
    elif isinstance(parser, NerfstudioDataParserConfig):
        path = data if data.suffix == ".json" else data / "transforms.json"
        if not path.is_file():
            raise no_transforms(data)
        check_transforms(path, splits=splits, camera_models=CAMERA_MODEL_TO_TYPE)


def view_index(camera: Cameras) -> int | None:
    """Index of the training view that :meth:`SundaeDatamanager.next_train` gave; None for other cameras."""
    return (camera.metadata or {}).get("cam_idx")


def check_cameras(cameras: Cameras, names: Sequence[Path]) -> str | None:
    """Check the poses and focal lengths of cameras ``[N]`` of training images with these names, in any units.

    Returns:
        A warning on poses that are possible, but make no good scene; None without one.

    Raises:
        DataError: an axis is mirrored, or a focal length belongs to no lens.
    """
    mirrored = torch.linalg.det(cameras.camera_to_worlds[:, :, :3]) < 0
    if mirrored.any():
        raise DataError(
            f"the pose of {names[_first(mirrored)].name} mirrors an axis ({int(mirrored.sum())} of {len(names)} poses "
            "do); negate one column of its rotation"
        )
    shares = cameras.fx / cameras.width.clamp_min(1)
    wrong = ((shares < LEAST_FOCAL) | (shares > MOST_FOCAL)).flatten()
    if wrong.any():
        at = _first(wrong)
        raise DataError(
            f"the focal length of {names[at].name} is {float(cameras.fx[at]):.3g} px and the image is "
            f"{int(cameras.width[at])} px wide, which no lens has; give the focal length in pixels"
        )
    centres = cameras.camera_to_worlds[:, :, 3]
    distances = (centres - centres.median(dim=0).values).norm(dim=1)
    if len(names) > 1 and distances.max() == 0:
        return "all cameras stand at one place, so nothing says how far things are; check the poses"
    usual = distances.median()
    far = distances > FARTHEST * usual.clamp_min(torch.finfo(usual.dtype).tiny)
    if usual > 0 and far.any():
        return (
            f"the camera of {names[_first(far)].name} is more than {FARTHEST:,} times as far away as most "
            f"({int(far.sum())} of {len(names)} are); check the poses"
        )
    return None


def _first(flags: Tensor) -> int:
    """Index of the first True."""
    return int(flags.nonzero()[0])


def _shows_something(batch: Mapping[str, Tensor]) -> bool:
    """Whether a pixel of an image is neither fully transparent nor masked."""
    image, mask = batch["image"], batch.get("mask")
    shown = None if mask is None else mask > 0
    if image.shape[-1] == 4:
        opaque = image[..., 3:] > 0
        shown = opaque if shown is None else opaque & shown.to(opaque.device)
    return shown is None or bool(shown.any())


def _fits(cameras: Cameras, device: torch.device) -> bool:
    """Whether the images of these cameras, three bytes a pixel, leave half of a GPU's free memory for the training."""
    if device.type != "cuda":
        return True
    size = 3 * int((cameras.width * cameras.height).sum())
    return size <= torch.cuda.mem_get_info(device)[0] / 2


class CheckedDataset(InputDataset):
    """nerfstudio's dataset; it names an image that cannot be decoded, and gives grey images if there is no capture."""

    def get_data(self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> dict[str, Any]:
        """Image, and mask if the capture has masks.

        Raises:
            DataError: a file of this view is damaged.
        """
        if self.metadata.get(NO_IMAGES):
            camera = self.cameras[image_idx]
            grey = torch.tensor(128, dtype=torch.uint8) if image_type == "uint8" else torch.tensor(0.5)
            image = grey.expand(int(camera.height.item()), int(camera.width.item()), 3)
            return {"image_idx": image_idx, "image": image, NO_IMAGES: True}
        try:
            return super().get_data(image_idx, image_type)
        except Exception as error:  # decoders raise many kinds with one meaning for the user
            raise undecodable(self.image_filenames[image_idx], error) from error


@dataclass
class SundaeDatamanagerConfig(FullImageDatamanagerConfig):
    """Full images, in an order that depends on the seed and the step alone."""

    _target: type = field(default_factory=lambda: SundaeDatamanager)
    holdout_every: int = 0
    """Hold out every n-th training view, for decisions that must not use test views. 0 holds out none."""
    images: bool = True
    """False for cameras without images, as sundae unpack writes them without a capture: for the viewer only."""

    @property
    def capture(self) -> Path:
        """Path of the capture."""
        return Path(self.dataparser.data if self.data is None else self.data)

    def check(self) -> None:
        """Check the capture before anything else of a training; see :func:`check_capture`."""
        check_capture(self.dataparser, self.capture, ("train", "val"), images=self.images)


class SundaeDatamanager(FullImageDatamanager[CheckedDataset]):
    """The stock datamanager of whole images, which also caches them on machines without CUDA and can hold out views.

    The view of a step is a function of seed and step, so a resumed run continues in the same order. Training cameras
    stay on the CPU, where reading their sizes does not wait for the GPU.
    """

    config: SundaeDatamanagerConfig

    def __init__(
        self,
        config: SundaeDatamanagerConfig,
        device: torch.device | str = "cpu",
        test_mode: Literal["test", "val", "inference"] = "val",
        **kwargs: Any,
    ) -> None:
        if config.train_cameras_sampling_strategy != "random":
            raise ConfigError(
                "train-cameras-sampling-strategy fps is not a function of seed and step, so a resumed run would "
                "differ; use random"
            )
        if config.holdout_every < 0 or config.holdout_every == 1:
            raise ConfigError(f"holdout-every is {config.holdout_every}; give 0 (none) or at least 2")
        if config.dataparser._target is Nerfstudio:
            config.dataparser._target = LightNerfstudioParser
        self._checked: list[InputDataset] = []
        data = config.capture
        check_capture(
            config.dataparser,
            data,
            ("train", "val" if test_mode == "val" else "test"),
            images=config.images and test_mode != "inference",
        )
        try:
            super().__init__(config, device, test_mode, **kwargs)
        except SundaeError:
            raise
        except EOFError as error:
            raise DataError(
                "nerfstudio asks whether to make the smaller images of --downscale-factor with ffmpeg, but there is no "
                "terminal to answer it; start the command once in a terminal and answer y, or train on images of full "
                "size with --downscale-factor 1"
            ) from error
        except Exception as error:  # parsers raise many kinds, assertions too, with one meaning for the user
            raise DataError(f"{data} cannot be parsed ({one_line(error)}); check the capture") from error
        self.hold_back(())
        self._cameras: dict[int, Cameras] = {}
        self.place: tuple[int, int] = (0, 1)
        """Rank of this process and number of ranks; each rank gets another view at a step."""

    def create_train_dataset(self) -> CheckedDataset:
        """Training set, with the transform from the capture's coordinates to the model's in its metadata."""
        outputs = self.train_dataparser_outputs
        if len(outputs.image_filenames) == 0:
            raise DataError(f"no training images in {self.config.dataparser.data}; check the path and the split")
        warning = check_cameras(outputs.cameras, outputs.image_filenames)
        if warning is not None:
            warn(warning)
        outputs.metadata[DATASET_FRAME] = (outputs.dataparser_transform, float(outputs.dataparser_scale))
        return self._marked(super().create_train_dataset())

    def create_eval_dataset(self) -> CheckedDataset:
        """Test set."""
        return self._marked(super().create_eval_dataset())

    def _marked(self, dataset: CheckedDataset) -> CheckedDataset:
        if not self.config.images:
            dataset.metadata[NO_IMAGES] = True
        return dataset

    @property
    def holdout_indices(self) -> list[int]:
        """Indices of the training views that are held out now."""
        return sorted({*range(len(self.train_dataset))}.difference(self._served))

    @property
    def train_indices(self) -> list[int]:
        """Indices of the training views that are not held out for the whole training."""
        every = self.config.holdout_every
        return [i for i in range(len(self.train_dataset)) if not every or (i + 1) % every]

    def hold_back(self, indices: Iterable[int]) -> None:
        """Hold out these of :attr:`train_indices` too, from the next step on, until the next call."""
        held_back = frozenset(indices)
        self._served = [index for index in self.train_indices if index not in held_back]
        self._order: tuple[int, list[int]] = (-1, [])  # pass over the views, and its order

    def view_of_step(self, step: int) -> int:
        """Index of the training view of ``step``: each pass over the views is a new permutation."""
        epoch, position = divmod(step, len(self._served))
        if self._order[0] != epoch:
            indices = list(self._served)
            random.Random(f"{self.config.train_cameras_sampling_seed}-{epoch}").shuffle(indices)
            self._order = (epoch, indices)
        return self._order[1][position]

    def training_views(self) -> Iterator[tuple[Cameras, torch.Tensor | None]]:
        """Training views that are not held out for the whole training: camera of shape ``(1,)`` on the CPU, and mask.

        The mask is bool ``[H, W, 1]``, True for pixels to train on; None for all pixels.
        """
        outputs = self.train_dataparser_outputs
        # nerfstudio masks the border of this lens by itself.
        round_lens = (outputs.cameras.camera_type == CameraType.FISHEYE624.value).any()
        masked = self.config.images and (outputs.mask_filenames is not None or bool(round_lens))
        for index in self.train_indices:
            # Read the mask first: undistortion changes the camera.
            mask = self.cached_train[index].get("mask") if masked else None
            yield self.train_dataset.cameras[index : index + 1], mask

    def holdout_views(self) -> Iterator[tuple[Cameras, dict[str, torch.Tensor]]]:
        """Held-out views as camera and batch, as nerfstudio's evaluation takes them; loaded one at a time."""
        for index in self.holdout_indices:
            yield self._view(index)

    def _view(self, index: int) -> tuple[Cameras, dict[str, torch.Tensor]]:
        batch = dict(self.cached_train[index])
        batch["image"] = batch["image"].to(self.device, non_blocking=True)  # pinned in host memory
        return self._camera(index), batch

    def _camera(self, index: int) -> Cameras:
        """A training camera, cached because nerfstudio's slicing is slow; ask for it after its image was read."""
        if index not in self._cameras:
            camera = self.train_dataset.cameras[index : index + 1]
            camera.metadata = {**(camera.metadata or {}), "cam_idx": index}
            self._cameras[index] = camera
        return self._cameras[index]

    def next_train(self, step: int) -> tuple[Cameras, dict[str, torch.Tensor]]:
        """Camera (on the CPU) and batch of ``step``."""
        rank, ranks = self.place
        return self._view(self.view_of_step(step * ranks + rank))

    def _load_images(
        self, split: Literal["train", "eval"], cache_images_device: Literal["cpu", "gpu"]
    ) -> list[dict[str, torch.Tensor]]:
        dataset = self.train_dataset if split == "train" else self.eval_dataset
        if not self.config.images:
            # The viewer loads all of them before its first frame.
            return super()._load_images(split, "gpu")
        self._check_images(dataset)
        if split == "train" and self.eval_dataset:
            # Report a damaged test view now, not at the prune.
            self._check_images(self.eval_dataset)
        if cache_images_device == "cpu" and not torch.cuda.is_available():
            # The stock "cpu" cache pins memory, which needs a driver; "gpu" means the model's device.
            cache_images_device = "gpu"
        elif cache_images_device == "gpu" and not _fits(dataset.cameras, torch.device(self.device)):
            CONSOLE.print(
                f"the {split} images need more than half of the free GPU memory: they stay in main memory, and each "
                "step copies one",
                soft_wrap=True,
            )
            cache_images_device = "cpu"
        loaded = super()._load_images(split, cache_images_device)
        if split == "train" and loaded and not any(map(_shows_something, loaded)):
            raise DataError(
                f"all {len(loaded)} training images are fully transparent or masked, so there is nothing to train on; "
                "check their alpha channel and their masks"
            )
        transparent = sum(batch["image"].shape[-1] == 4 for batch in loaded)
        if split == "train" and transparent:
            CONSOLE.print(
                f"{transparent} of {len(loaded)} training images have an alpha channel: what is transparent is trained "
                "to be empty space. To leave pixels out instead, give masks (mask_path in transforms.json)",
                soft_wrap=True,
            )
        return loaded

    def _check_images(self, dataset: InputDataset) -> None:
        """Check the files of a dataset once, because undistortion, which comes with loading, crops the cameras."""
        if any(checked is dataset for checked in self._checked):
            return
        scale = dataset.scale_factor
        masks: Sequence[Path | None] = dataset._dataparser_outputs.mask_filenames or [None] * len(dataset)
        widths, heights = dataset.cameras.width.flatten().tolist(), dataset.cameras.height.flatten().tolist()
        for path, mask, *expected in zip(dataset.image_filenames, masks, widths, heights):
            full = check_image(path)
            size = [int(side * scale) for side in full]
            if size != expected:
                raise DataError(
                    f"{path.name} is {size[0]} x {size[1]} px but its camera says {expected[0]} x {expected[1]}; "
                    "give each size its own camera, or resize the images"
                )
            if mask is not None and check_image(mask, mask=True) != full:
                raise DataError(f"{mask} differs in size from its image {path.name}; make it {full[0]} x {full[1]} px")
        self._checked.append(dataset)
