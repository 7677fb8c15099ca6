"""nerfstudio's full-image datamanager with checks of the capture, held-out views, and an order that can be resumed."""

from __future__ import annotations

import logging
import random
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, Literal, cast

import cv2
import numpy as np
import torch
import tyro
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers import full_images_datamanager
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset, get_image_mask_tensor_from_path
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from sundae_ns.core.errors import ConfigError, DataError, SundaeError, one_line, reading
from sundae_ns.data.images import TURNED, check_image, decoded, decoded_mask, exif_orientation, turned, wrong_size
from sundae_ns.data.layouts import larger_model, unused_masks
from sundae_ns.plugin.dataparsers import check_cameras, check_capture, check_ranges, check_tests, rebound, set_parser

_log = logging.getLogger(__name__)

DATASET_FRAME = "sundae_dataset_frame"
"""Metadata key of the training set: transform ``[3, 4]`` and scale from the capture's coordinates to the model's."""


def _shows_something(batch: Mapping[str, Tensor]) -> bool:
    """Whether a pixel of an image is neither fully transparent nor masked."""
    image, mask = batch["image"], batch.get("mask")
    opaque = image[..., 3:] > 0 if image.shape[-1] == 4 else torch.ones_like(image[..., :1], dtype=torch.bool)
    return bool((opaque if mask is None else opaque & (mask > 0).to(opaque.device)).any())


class CheckedDataset(InputDataset):
    """nerfstudio's dataset; it names an image that cannot be decoded.

    Its cameras are perspective ones, as their images are once they are loaded.
    """

    def __init__(self, dataparser_outputs: DataparserOutputs, scale_factor: float = 1.0) -> None:
        super().__init__(dataparser_outputs, scale_factor)
        self.lenses = self.cameras.camera_type  # Camera types of the files, by which images are undistorted
        self.cameras.camera_type = torch.full_like(self.lenses, CameraType.PERSPECTIVE.value)
        self.turned: dict[int, int] = {}  # EXIF orientations of images that their cameras see turned
        self._checked = False

    def check_images(self) -> None:
        """Check the files once, because undistortion crops the cameras; ``DataError`` names a wrong image or mask."""
        if self._checked:
            return
        masks: Sequence[Path | None] = self._dataparser_outputs.mask_filenames or [None] * len(self)
        widths, heights = self.cameras.width.flatten().tolist(), self.cameras.height.flatten().tolist()
        for index, (path, mask, *expected) in enumerate(zip(self.image_filenames, masks, widths, heights)):
            full = check_image(path)
            if min(expected) < 1:
                raise DataError(f"{path} has no pixel at the given scale of images; give a larger one")
            if self._scaled(full) != expected:
                orientation = exif_orientation(path)
                if orientation not in TURNED or self._scaled(full[::-1]) != expected:
                    raise wrong_size(path, full, (expected[0], expected[1]), orientation)
                self.turned[index] = orientation
                full = full[::-1]
            if mask is not None and check_image(mask, mask=True) != full:
                raise DataError(f"{mask} differs in size from its image {path.name}; make it {full[0]} x {full[1]} px")
            if mask is not None and (turn := exif_orientation(mask)) != 1 and turn != exif_orientation(path):
                raise DataError(f"{mask} is turned by its EXIF entry, and its image is not; save both upright")
        self._checked = True

    def _scaled(self, size: tuple[int, int]) -> list[int]:
        return [int(side * self.scale_factor) for side in size]

    def get_numpy_image(self, image_idx: int) -> NDArray[np.uint8]:
        """Pixels ``[H, W, 3 or 4]`` in sRGB, turned as the camera sees them."""
        read = rebound(InputDataset.get_numpy_image, Image=SimpleNamespace(open=decoded, Resampling=Image.Resampling))
        pixels: NDArray[np.uint8] = read(self, image_idx)
        turn = self.turned.get(image_idx)
        return pixels if turn is None else np.array(turned(Image.fromarray(pixels), turn))

    def get_data(self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> dict[str, Any]:
        """Image, and mask if the capture has masks; ``DataError`` if a file of this view is damaged."""
        with reading(self.image_filenames[image_idx], "an image that can be decoded", remedy="repair or remove it"):
            images = SimpleNamespace(open=decoded_mask, Resampling=Image.Resampling)
            mask = rebound(get_image_mask_tensor_from_path, Image=images)
            read = rebound(InputDataset.get_data, get_image_mask_tensor_from_path=mask)
            return cast(dict[str, Any], read(self, image_idx, image_type))


class NoTestViews:
    """In place of the cameras of a test set that is too small: what needs them reads them, and fails in one line."""

    def __init__(self, capture: Path) -> None:
        self._capture = capture

    def __getattr__(self, name: str) -> Any:
        remedy = "ns-render --pose-source train or --split train, or train with a --train-split-fraction below 1"
        raise DataError(f"{self._capture} has too few test views to measure or render; give {remedy}")

    def __len__(self) -> int:
        return int(self.__getattr__("len"))


@dataclass
class SundaeDatamanagerConfig(FullImageDatamanagerConfig):
    """Full images, in an order that depends on the seed and the step alone."""

    _target: type = field(default_factory=lambda: SundaeDatamanager)
    robust_frame: Annotated[bool, tyro.conf.Suppress] = False
    """Of the method: the scene is centred and scaled by the cameras that stand near each other, and survey coordinates
    are shifted in float64. False takes all cameras, as nerfstudio does."""

    @property
    def capture(self) -> Path:
        """Path of the capture."""
        return Path(self.dataparser.data if self.data is None else self.data)


class SundaeDatamanager(FullImageDatamanager[CheckedDataset]):
    """The stock datamanager of whole images, which also caches them on machines without CUDA and can hold out views.

    Training cameras stay on the CPU, where reading their sizes does not wait for the GPU.
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
            raise ConfigError("train-cameras-sampling-strategy fps is not a function of seed and step; use random")
        check_ranges(config)
        set_parser(config.dataparser, config.robust_frame)
        splits = ("train", "val" if test_mode == "val" else "test")
        check_capture(config.dataparser, config.capture, splits, images=test_mode != "inference")
        try:
            super().__init__(config, device, test_mode, **kwargs)
        except SundaeError:
            raise
        except EOFError as error:
            asked = "nerfstudio asks whether to make the smaller images of --downscale-factor, and no terminal answers"
            remedy = "start the command once in a terminal and answer y, or give --downscale-factor 1"
            raise DataError(f"{asked}; {remedy}") from error
        except Exception as error:  # parsers raise many kinds, assertions too, with one meaning for the user
            raise DataError(f"{config.capture} cannot be parsed ({one_line(error)}); check the capture") from error
        self.hold_out(())
        self._cameras: dict[int, Cameras] = {}
        self.rank = 0  # Rank of this process: at a step, rank r trains on the view that one process takes r steps later

    def create_train_dataset(self) -> CheckedDataset:
        """Training set, with the transform from the capture's coordinates to the model's in its metadata."""
        outputs, parser = self.train_dataparser_outputs, cast(Any, self.config.dataparser)
        if (count := len(outputs.image_filenames)) < 2:
            few = f"{parser.data} has {count or 'no'} training image{'s' * (count != 1)}, and training needs 2 or more"
            raise DataError(f"{few}; check the path and the split (--eval-mode)")
        check_cameras(outputs.cameras, outputs.image_filenames, outputs.metadata.get("points3D_xyz"))
        is_colmap = isinstance(parser, ColmapDataParserConfig)
        folder = self.config.capture.parent if self.config.capture.is_file() else self.config.capture
        if outputs.mask_filenames is None and (masks := unused_masks(folder)) is not None:
            how = f"colmap --masks-path {masks} (sundae train: --masks)" if is_colmap else "mask_path in each frame"
            _log.warning(f"{folder / masks} is not used; to leave out what its masks hide, give {how}")
        if is_colmap and (larger := larger_model(folder, parser.colmap_path)) is not None:
            _log.warning(larger)
        outputs.metadata.setdefault("points3D_rgb", torch.empty(0, 3))  # without colours, a cloud is grey
        transform = outputs.dataparser_transform.clone()
        # nerfstudio states the translation after the scale that a capture has been given.
        transform[:, 3] /= getattr(self.dataparser, "applied_scale", 1.0)
        outputs.metadata[DATASET_FRAME] = (transform, float(outputs.dataparser_scale))
        return super().create_train_dataset()

    def create_eval_dataset(self) -> CheckedDataset:
        """Test set."""
        dataset = super().create_eval_dataset()
        if len(dataset) > (sys.argv[1:2] == ["interpolate"]):  # ns-render needs two for a path between them
            check_tests(self.train_dataparser_outputs, dataset)
        else:
            dataset.cameras = cast(Any, NoTestViews(self.config.capture))
        return dataset

    @property
    def train_indices(self) -> list[int]:
        """Indices of all training views."""
        return [*range(len(self.train_dataset))]

    def hold_out(self, indices: Iterable[int]) -> None:
        """Hold these training views out, from the next step on, until the next call."""
        self.held_out_indices = sorted(set(indices))
        self._served = [index for index in self.train_indices if index not in self.held_out_indices]
        self._order: tuple[int, list[int]] = (-1, [])  # pass over the views, and its order

    def view_of_step(self, step: int) -> int:
        """Index of the training view of ``step``: each pass over the views is a new permutation."""
        epoch, position = divmod(step, len(self._served))
        if self._order[0] != epoch:
            self._order = (epoch, list(self._served))
            random.Random(f"{self.config.train_cameras_sampling_seed}-{epoch}").shuffle(self._order[1])
        return self._order[1][position]

    def training_views(self) -> Iterator[tuple[Cameras, Tensor | None]]:
        """All training views: camera of shape ``(1,)`` on the CPU, and the mask, if any, bool ``[H, W, 1]``."""
        outputs, lenses = self.train_dataparser_outputs, self.train_dataset.lenses
        # Undistortion masks what a fisheye lens has not seen.
        masked = outputs.mask_filenames is not None or bool((lenses != CameraType.PERSPECTIVE.value).any())
        for index in self.train_indices:
            # Read the mask first: undistortion changes the camera.
            mask = self.cached_train[index].get("mask") if masked else None
            yield self._camera(index), mask

    def cameras(self, indices: Iterable[int]) -> Iterator[tuple[Cameras, dict[str, Tensor]]]:
        """Training views as camera and batch, loaded one at a time."""
        return map(self._view, indices)

    def _view(self, index: int) -> tuple[Cameras, dict[str, Tensor]]:
        batch = dict(self.cached_train[index])  # first: undistortion, which comes with it, changes the camera
        batch["image"] = batch["image"].to(self.device, non_blocking=True)  # pinned in host memory
        return self._camera(index), batch

    def _camera(self, index: int) -> Cameras:
        """Camera of a training view, kept because nerfstudio's slicing is slow; its index is for a camera optimizer."""
        if index not in self._cameras:
            camera = self.train_dataset.cameras[index : index + 1]
            camera.metadata = {**(camera.metadata or {}), "cam_idx": index}
            self._cameras[index] = camera
        return self._cameras[index]

    def next_train(self, step: int) -> tuple[Cameras, dict[str, Tensor]]:
        """Camera (on the CPU) and batch of ``step``."""
        return self._view(self.view_of_step(step + self.rank))

    def _load_images(
        self, split: Literal["train", "eval"], cache_images_device: Literal["cpu", "gpu"]
    ) -> list[dict[str, Tensor]]:
        dataset = self.train_dataset if split == "train" else self.eval_dataset
        dataset.check_images()
        if split == "train" and self.eval_dataset:
            self.eval_dataset.check_images()  # report a damaged test view now, not at the prune
        device, cameras = torch.device(self.device), dataset.cameras
        size = {"uint8": 3, "float32": 12}[self.config.cache_images_type] * int((cameras.width * cameras.height).sum())
        full = device.type == "cuda" and size > torch.cuda.mem_get_info(device)[0] / 2
        if cache_images_device == "cpu" and not torch.cuda.is_available():
            # The stock "cpu" cache pins memory, which needs a driver; "gpu" means the model's device.
            cache_images_device = "gpu"
        elif cache_images_device == "gpu" and full:
            _log.info(f"the {split} images need more than half of the free GPU memory, so they stay in main memory")
            cache_images_device = "cpu"
        load = rebound(FullImageDatamanager._load_images, _undistort_image=undistorting(dataset.image_filenames))
        perspective, cameras.camera_type = cameras.camera_type, dataset.lenses  # undistort by the types of the files
        try:
            loaded: list[dict[str, Tensor]] = load(self, split, cache_images_device)
        finally:
            cameras.camera_type = perspective
        if split == "train" and loaded and not any(map(_shows_something, loaded)):
            nothing = f"all {len(loaded)} training images are fully transparent or masked"
            raise DataError(f"{nothing}; check their alpha channel and their masks")
        if split == "train" and (transparent := sum(batch["image"].shape[-1] == 4 for batch in loaded)):
            what = f"{transparent} of {len(loaded)} training images have an alpha channel"
            _log.info(f"{what}: transparent pixels are trained as empty space; to leave pixels out, give masks")
        return loaded


Result = tuple[NDArray[Any], NDArray[Any], Any]  # Intrinsics [3, 3], image [H, W, C] and mask


def undistorting(paths: Sequence[Path]) -> Callable[..., Result]:
    """nerfstudio's function that undistorts an image, with lenses that see the half space, and wrong distortions.

    OpenCV chooses the focal length of a fisheye photo's perspective image by the rays at the middles of its edges. Rays
    at 90 degrees and more have no place in one, and the focal length becomes nothing. A distortion that no image of the
    ``paths`` can have raises ``DataError``.
    """

    def undistort(camera: Any, distortion_params: Any, data: Any, image: Any, K: Any) -> Result:
        intrinsics = K.copy()
        mask = data.get("mask")
        kind = int(camera.camera_type)
        cause = "has a distortion that leaves no image"
        if kind == CameraType.PERSPECTIVE.value and distortion_params[3]:
            if (filled := _of_brown(intrinsics, distortion_params, image, mask)) is not None:
                return filled
        else:
            try:
                stock: Result = full_images_datamanager._undistort_image(camera, distortion_params, data, image, K)
                ratio = float(stock[0][0, 0]) / max(stock[1].shape[1], 1)
                # A view of more than 157 degrees (a ratio of 0.1) shows a smear.
                if np.isfinite(stock[0]).all() and 0.1 <= ratio <= 1000 and (stock[1].any() or not image.any()):
                    return stock
                if kind == CameraType.FISHEYE.value and _is_lens(distortion_params, intrinsics, image):
                    return _middle(intrinsics, distortion_params, image, mask)
            except (AssertionError, LookupError, TypeError, ValueError, cv2.error) as error:
                cause = f"cannot be undistorted ({one_line(error)})"
        values = ", ".join(f"{float(value):.3g}" for value in distortion_params)
        what = f"{paths[int(data['image_idx'])].name} {cause}; check its k1 ... p2 ({values})"
        raise DataError(f"{what}, which are of coordinates in focal lengths, not in pixels")

    return undistort


def _of_brown(K: NDArray[Any], distortion: Any, image: NDArray[Any], mask: Any) -> Result | None:
    """The largest perspective image that a photo fills, by all four radial coefficients; OpenCV has three of them.

    None if no image of a quarter of the focal length to three times it is filled.
    """
    height, width = image.shape[:2]
    fx, fy, cx, cy = (float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    k1, k2, k3, k4, p1, p2 = map(float, distortion)
    # OpenCV's pixels have whole numbers at their middles.
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    for zoom in np.geomspace(0.25, 3, 85):  # steps of 3%
        x, y = (u - cx) / (zoom * fx), (v - cy) / (zoom * fy)
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        across = (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) * fx + cx - 0.5
        down = (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) * fy + cy - 0.5
        maps = across.astype(np.float32), down.astype(np.float32)
        inside = (maps[0] >= 0) & (maps[0] <= width - 1) & (maps[1] >= 0) & (maps[1] <= height - 1)
        # Where the lens turns rays back, coordinates fall again.
        if inside.all() and (np.diff(maps[0], axis=1) > 0).all() and (np.diff(maps[1], axis=0) > 0).all():
            new = np.array([[zoom * fx, 0, cx], [0, zoom * fy, cy], [0, 0, 1]], dtype=np.float32)
            image = cv2.remap(image, *maps, interpolation=cv2.INTER_LINEAR)
            mask = None if mask is None else torch.from_numpy(_remapped(mask, image.shape, maps)).bool()[..., None]
            return new, image, mask
    return None


def _remapped(mask: Any, shape: tuple[int, ...], maps: tuple[NDArray[Any], NDArray[Any]]) -> NDArray[np.uint8]:
    """A mask ``[H, W, 1]`` at other pixels, from 0 to 255."""
    stored = mask.numpy().astype(np.uint8).reshape(shape[:2]) * 255
    return np.asarray(cv2.remap(stored, *maps, interpolation=cv2.INTER_LINEAR))


def _is_lens(distortion: Any, K: NDArray[Any], image: NDArray[Any]) -> bool:
    """Whether rays at larger angles lie farther out, up to the edges of a fisheye photo or to 90 degrees."""
    theta = np.linspace(0, np.pi / 2, 500)
    radius = theta * (1 + sum(float(k) * theta ** (2 * i + 2) for i, k in enumerate(distortion[:4])))
    outside = radius >= min(image.shape[1] / 2 / K[0, 0], image.shape[0] / 2 / K[1, 1])
    last = int(np.argmax(outside)) if outside.any() else len(theta) - 1
    return bool((np.diff(radius[: last + 1]) > 0).all())


def _middle(K: NDArray[Any], distortion: Any, image: NDArray[Any], mask: Any) -> Result:
    """The perspective image of the middle of a fisheye photo, to 60 degrees at the middles of its edges."""
    height, width = image.shape[:2]
    # OpenCV's pixels have whole numbers at their middles.
    old = K.astype(np.float64)
    old[:2, 2] -= 0.5
    k = np.array(distortion[:4], dtype=np.float64)
    focal = max(width, height) / 2 / np.tan(np.radians(60))
    new = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1]])
    maps = cv2.fisheye.initUndistortRectifyMap(old, k, np.eye(3), new, (width, height), cv2.CV_32FC1)
    valid = (maps[0] > -0.5) & (maps[0] < width - 0.5) & (maps[1] > -0.5) & (maps[1] < height - 0.5)
    if mask is not None:
        valid &= _remapped(mask, image.shape, maps) > 127
    image = cv2.remap(image, *maps, interpolation=cv2.INTER_LINEAR)
    new[:2, 2] += 0.5
    mask = None if mask is None and valid.all() else torch.from_numpy(valid)[..., None]
    return new.astype(np.float32), image, mask
