"""Measure the flicker of a head along camera paths, over that of base colours, as StopThePop measures popping.

    python benchmarks/flicker.py --load-config RUN
    python benchmarks/flicker.py --load-config RUN --json

An earlier frame is warped onto a later one (Radl et al., SIGGRAPH 2024). Where both see the same surface, what is left
of their difference is view dependence, error of the warp, and flicker. The first two are about the same in all methods,
so the least squared error of a pixel over the methods is subtracted. StopThePop warps by optical flow; here depth and
cameras are known. A sharper image leaves more of it than a blurred one, with the same flicker.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass
from io import StringIO
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
import tyro
from nerfstudio.cameras.cameras import Cameras
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from torch import Tensor

from harness.script import run_script
from sundae_ns.errors import ConfigError, DataError
from sundae_ns.evaluation import without_nan
from sundae_ns.evaluation.document import number
from sundae_ns.scenes.models import Opened, load_model

FRAMES_APART = (1, 7)
"""Distances of compared frames, as in StopThePop: flicker from one frame to the next, and what builds up slowly."""
FRAMES = 15
"""Frames of a path."""
FRAMES_BETWEEN = 20
"""Frames from one training camera to its neighbour; a path goes part of the way."""
SAME_DEPTH = 0.02
"""Relative difference of depths up to which two frames see the same surface."""
LEAST_ALPHA = 0.95
"""Accumulation from which on a pixel shows a surface."""


class Frame(NamedTuple):
    """One frame of a path, drawn by several methods."""

    images: Tensor
    """One image of each method ``[M, H, W, 3]``."""
    depth: Tensor
    """Depth along the optical axis, world units ``[H, W, 1]``."""
    alpha: Tensor
    """Accumulation ``[H, W, 1]``."""
    viewmat: Tensor
    """World-to-camera, OpenCV axes ``[4, 4]``."""
    K: Tensor
    """Intrinsics in pixels ``[3, 3]``."""


def warp(earlier: Frame, later: Frame) -> tuple[Tensor, Tensor]:
    """The images of an earlier frame in the pixels of a later one.

    Returns:
        The images ``[M, H, W, 3]``, and where both frames see the same surface ``[H, W]``, bool.
    """
    height, width = later.depth.shape[:2]
    device = later.depth.device
    rows, columns = (torch.arange(side, device=device) + 0.5 for side in (height, width))
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    points = torch.stack([x, y, torch.ones_like(x)], dim=-1) @ torch.linalg.inv(later.K).T * later.depth
    motion = earlier.viewmat @ torch.linalg.inv(later.viewmat)
    points = points @ motion[:3, :3].T + motion[:3, 3]
    z = points[..., 2:]
    sides = torch.tensor([earlier.depth.shape[1], earlier.depth.shape[0]], device=device)
    grid = 2 * (points @ earlier.K.T)[..., :2] / z.clamp_min(1e-8) / sides - 1

    def sampled(value: Tensor, mode: str) -> Tensor:
        """Values ``[B, H, W, C]`` of the earlier frame where the later frame's pixels lie in it."""
        grids = grid.expand(len(value), -1, -1, -1)
        found = F.grid_sample(value.permute(0, 3, 1, 2), grids, mode=mode, padding_mode="border", align_corners=False)
        return found.permute(0, 2, 3, 1)

    depth, alpha = sampled(torch.cat([earlier.depth, earlier.alpha], dim=-1)[None], "bilinear")[0].split(1, dim=-1)
    inside = (z > 0) & (grid.abs() <= 1).all(dim=-1, keepdim=True)
    same = ((depth - z).abs() <= SAME_DEPTH * z) & (torch.minimum(alpha, later.alpha) > LEAST_ALPHA)
    return sampled(earlier.images, "bicubic"), (inside & same)[..., 0]


class Flicker:
    """Sums over the pairs of frames of one or more paths."""

    def __init__(self) -> None:
        self._errors: Tensor | None = None
        self._least = 0.0
        self._seen, self._pixels = 0, 0

    def add(self, earlier: Frame, later: Frame) -> None:
        """Count a pair of frames."""
        images, seen = warp(earlier, later)
        errors = (images - later.images).square().mean(dim=-1)[:, seen].double()
        total = errors.sum(dim=1).cpu()
        self._errors = total if self._errors is None else self._errors + total
        self._least += float(errors.amin(dim=0).sum())
        self._seen += int(seen.sum())
        self._pixels += seen.numel()

    @property
    def seen(self) -> float:
        """Share of the pixels that both frames of a pair see; 0 without pairs."""
        return self._seen / max(self._pixels, 1)

    def errors(self) -> list[float]:
        """Mean squared error of each method's warped frames; empty without pairs, NaN if no pair shares a pixel."""
        if self._errors is None:
            return []
        return (self._errors / self._seen if self._seen else self._errors * torch.nan).tolist()

    def excess(self) -> list[float]:
        """:meth:`errors` without the least error of each pixel over the methods: the flicker.

        Figures compare only within one call: another set of methods has another least.
        """
        least = self._least / max(self._seen, 1)
        return [error - least for error in self.errors()]


@dataclass(frozen=True)
class FlickerFigures:
    """Flicker of frames at one distance; squared errors of colours in [0, 1], NaN where frames share no pixel."""

    frames_apart: int
    mse: float
    """Mean squared error of warped compensated frames."""
    mse_base: float
    """The same of base colours."""
    excess: float
    """:attr:`mse` without the least of each pixel over all measured images."""
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
    opened: Opened, *, places: int = 3, progress: Callable[[], object] | None = None
) -> list[FlickerFigures]:
    """Measure the flicker of compensated images and base colours, for each of :data:`FRAMES_APART`.

    Args:
        opened: a scene with a head.
        places: number of paths, each between two neighbouring training cameras.
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
    for pair in pairs:
        frames: list[Frame] = []
        for frame in _path(opened, cameras, pair):
            frames.append(frame)
            for apart, total in totals.items():
                if len(frames) > apart:
                    total.add(frames[-1 - apart], frame)
            if progress is not None:
                progress()
    return [
        FlickerFigures(apart, mse, mse_base, excess, excess_base, total.seen, len(pairs))
        for apart, total in totals.items()
        for (mse, mse_base), (excess, excess_base) in [(total.errors(), total.excess())]
    ]


def _path(opened: Opened, cameras: Cameras, pair: tuple[int, int]) -> Iterator[Frame]:
    """Frames of a path from the first camera of a pair towards the second: compensated ones, and last base colours."""
    first, second = (cameras.camera_to_worlds[index].double() for index in pair)
    model = opened.model
    for place in range(FRAMES):
        camera = cameras[pair[0] : pair[0] + 1]
        camera.camera_to_worlds = between(first, second, place / FRAMES_BETWEEN)[None].to(cameras.camera_to_worlds)
        camera.metadata = None  # the training view's own, such as its place in a camera optimizer
        camera = camera.to(model.device)
        outputs = model.get_outputs_for_camera(camera)
        images = torch.stack([outputs["rgb"], outputs["base_rgb"]]).float()
        view = model.view_of(camera)
        # Clones: a recorded frame draws into the same tensors again.
        yield Frame(images, outputs["depth"].clone(), outputs["accumulation"].clone(), view.viewmat, view.K)


def flicker(
    load_config: Path,
    places: int = 3,
    data: Path | None = None,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Measure and print; the exit code.

    Args:
        load_config: the folder of a run with a head, or its config.yml.
        places: number of paths, each between two neighbouring training cameras.
        data: folder of the capture, if it moved.
        as_json: print one line of JSON for each distance of frames, instead of a table.
    """
    console = Console(stderr=True)
    with console.status("Opening the run"), redirect_stdout(StringIO()):  # nerfstudio prints while it loads
        run = load_model(load_config, data=data)
        _ = run.datamanager.cached_train  # loads the training images, whose undistortion changes their cameras
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("Rendering paths", total=places * FRAMES)
        found = measure_flicker(run, places=places, progress=lambda: progress.advance(task))
    if as_json:
        device = torch.cuda.get_device_name() if run.model.device.type == "cuda" else "cpu"
        where = {"config": str(load_config), "scene": run.scene, "device": device, "fingerprint": run.fingerprint}
        for one in found:
            print(json.dumps(without_nan({**where, **asdict(one), "ratio": one.ratio}), allow_nan=False))
        return 0
    table = Table(
        title=f"{run.model.num_points:,} primitives, {found[0].paths} paths of {FRAMES} frames",
        caption="squared errors of warped frames x 1e6; flicker: without the least of all rows and base at each pixel",
    )
    for column in ("frames apart", "head", "base", "flicker: head", "base", "head / base"):
        table.add_column(column, justify="right", no_wrap=True)
    for one in found:
        errors = [number(1e6 * error, 1) for error in (one.mse, one.mse_base, one.excess, one.excess_base)]
        table.add_row(str(one.frames_apart), *errors, number(one.ratio, 2))
    Console().print(table)
    return 0


if __name__ == "__main__":
    run_script(flicker, __doc__)
