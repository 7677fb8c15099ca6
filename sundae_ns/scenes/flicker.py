"""Flicker of a scene's compensated images and of its base colours, along paths between training cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sundae_ns.errors import ConfigError, DataError
from sundae_ns.evaluation.flicker import Flicker, Frame
from sundae_ns.scenes.measure import head_as
from sundae_ns.scenes.opening import Opened

FRAMES_APART = (1, 7)
"""Distances of compared frames, as in StopThePop: flicker from one frame to the next, and what builds up slowly."""
FRAMES = 15
"""Frames of a path."""
FRAMES_BETWEEN = 20
"""Frames from one training camera to its neighbour; a path goes part of the way."""


@dataclass(frozen=True)
class FlickerFigures:
    """Flicker of frames at one distance; squared errors of colours in [0, 1], NaN where frames share no pixel."""

    phases: int
    """Runs of the head for a frame."""
    frames_apart: int
    mse: float
    """Mean squared error of warped compensated frames."""
    mse_base: float
    """The same of base colours."""
    excess: float
    """:attr:`mse` without the least over all measured frames, of base colours and of each number of runs, at each pixel."""
    excess_base: float
    """:attr:`mse_base` without this least."""
    seen: float
    """Share of the pixels that both frames see."""
    paths: int
    """Number of paths."""

    @property
    def ratio(self) -> float:
        """Flicker of the compensated frames over that of base colours; NaN if neither is left or known."""
        if self.excess_base > 0:
            return self.excess / self.excess_base
        return math.inf if self.excess > 0 else math.nan


def neighbours(poses: Tensor, places: int) -> list[tuple[int, int]]:
    """Cameras evenly over a capture, each with the nearest one that looks the same way, within 45 degrees.

    Args:
        poses: camera-to-world, OpenGL axes ``[N, 3, 4]``.
        places: number of pairs; fewer cameras give fewer.

    Raises:
        DataError: there are fewer than two cameras.
    """
    if len(poses) < 2:
        raise DataError(f"a path needs two training views, and the capture has {len(poses)}")
    chosen = torch.linspace(0, len(poses) - 1, min(places, len(poses)) + 2).round().long()[1:-1].unique()
    centres, axes = poses[:, :, 3], poses[:, :, 2]
    pairs = []
    for camera in chosen.tolist():
        far = (centres - centres[camera]).norm(dim=1)
        # A camera that looks elsewhere comes after all that look the same way.
        far = far + (axes @ axes[camera] < 0.5**0.5) * (2 * far.max() + 1)
        far[camera] = torch.inf
        pairs.append((camera, int(far.argmin())))
    return pairs


def between(first: Tensor, second: Tensor, share: float) -> Tensor:
    """The pose a share of the way from one to another; a blend of both rotations, made orthogonal.

    Args:
        first: camera-to-world ``[3, 4]``.
        second: camera-to-world ``[3, 4]``, less than a half turn away.
        share: 0 for the first, 1 for the second.
    """
    pose = torch.lerp(first, second, share)
    u, _, v = torch.linalg.svd(pose[:, :3])
    pose[:, :3] = u @ v
    return pose


@torch.no_grad()
def measure_flicker(
    opened: Opened, *, places: int = 3, phases: Sequence[int] = (), progress: Callable[[], object] | None = None
) -> list[FlickerFigures]:
    """Measure the flicker of compensated images and base colours, for each of ``phases`` and :data:`FRAMES_APART`.

    Args:
        opened: a scene with a head.
        places: number of paths, each between two neighbouring training cameras.
        phases: runs of the head for a frame, each one of ``PHASES``; by default the scene's own.
        progress: called after each frame.

    Raises:
        ConfigError: the scene has no head, or there are no places.
        DataError: there are fewer than two training views.
    """
    if not opened.model.state.head_enabled:
        raise ConfigError(f"{opened.source} has no head, so there is nothing to compare with base colours")
    if places < 1:
        raise ConfigError(f"flicker cannot be measured at {places} places; give at least 1")
    _ = opened.datamanager.cached_train  # undistortion, which comes with loading, changes the cameras
    cameras = opened.datamanager.train_dataset.cameras
    totals = {apart: Flicker() for apart in FRAMES_APART}
    pairs = neighbours(cameras.camera_to_worlds, places)
    assert opened.model.head is not None
    counts = list(dict.fromkeys(phases)) or [opened.model.head.config.phases]
    for pair in pairs:
        frames: list[Frame] = []
        for frame in _path(opened, cameras, pair, counts):
            frames.append(frame)
            for apart, total in totals.items():
                if len(frames) > apart:
                    total.add(frames[-1 - apart], frame)
            if progress is not None:
                progress()
    # Base colours are the last of the methods.
    measured = [(apart, total.errors(), total.excess(), total.seen) for apart, total in totals.items()]
    return [
        FlickerFigures(
            count, apart, errors[number], errors[-1], excesses[number], excesses[-1], seen=seen, paths=len(pairs)
        )
        for number, count in enumerate(counts)
        for apart, errors, excesses, seen in measured
    ]


def _path(opened: Opened, cameras: Cameras, pair: tuple[int, int], phases: Sequence[int]) -> Iterator[Frame]:
    """Frames of a path from the first camera of a pair towards the second: compensated ones, and last base colours."""
    first, second = (cameras.camera_to_worlds[index].double() for index in pair)
    model = opened.model
    for number in range(FRAMES):
        camera = cameras[pair[0] : pair[0] + 1]
        camera.camera_to_worlds = between(first, second, number / FRAMES_BETWEEN)[None].to(cameras.camera_to_worlds)
        camera.metadata = None  # the training view's own, such as its place in a camera optimizer
        camera = camera.to(model.device)
        compensated = []
        for count in phases:
            with head_as(model, phases=count):
                outputs = model.get_outputs_for_camera(camera)
                compensated.append(outputs["rgb"].clone())
        images = torch.stack([*compensated, outputs["base_rgb"]]).float()
        view = model.view_of(camera)
        # Clones: a recorded frame draws into the same tensors again.
        yield Frame(images, outputs["depth"].clone(), outputs["accumulation"].clone(), view.viewmat, view.K)
