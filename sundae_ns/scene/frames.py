"""Images of finished scenes for viewers: outputs computed on first access, and frames as recorded CUDA graphs."""

from __future__ import annotations

import logging
from collections import UserDict
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from threading import Lock
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import BackendError, DataError
from sundae_ns.core.gaussians import FEATURES, Gaussians
from sundae_ns.cuda.cuda_graphs import GraphCache, record, warm_up
from sundae_ns.pruning.rule import PruneRule
from sundae_ns.pruning.scores import response
from sundae_ns.rasterize.gsplat_backend import RecordableGsplat
from sundae_ns.rasterize.gsplat_kernels import Capacity
from sundae_ns.scene.render import GaussianSource, RenderSettings, render_view, scale_plan, splat

_log = logging.getLogger(__name__)

OUTPUTS = ("rgb", "base_rgb", "depth", "accumulation", "features", "response")  # in the order of viewers' lists
GaussiansKey = tuple[int, int]  # a state of the Gaussians: their number, and the number of prunes
SPARE_CAPACITY = 1.5  # for tile and Gaussian pairs, as a multiple of the recorded view's: another view may have more
REPLAYED = ("rgb", "base_rgb", "accumulation")  # images of a recorded frame


class LazyOutputs(UserDict[str, Any]):
    """Named outputs. A function is called on first access, perhaps in another thread, and its value kept."""

    def __getitem__(self, name: str) -> Any:
        value = self.data[name]
        if callable(value):
            with torch.no_grad():
                value = self.data[name] = value()
        return value


class ShownResponse:
    """Spectral response for display, kept until the Gaussians are pruned again."""

    def __init__(self) -> None:  # one tuple, because the viewer reads it from its own thread
        self._last: tuple[GaussiansKey | None, Tensor | None] = (None, None)

    def values(self, gaussians: Gaussians, key: GaussiansKey | None, rule: PruneRule) -> Tensor | None:
        """Values in [0, 1] ``[N]``; None without a response, as for a single Gaussian, or while Gaussians grow."""
        of, values = self._last
        if of != key:
            values = None
            with suppress(DataError):
                values = response_values(response(gaussians, rule)) if key is not None else None
            self._last = (key, values)
        return values


def late_outputs(
    images: Mapping[str, Any],
    drawn: Gaussians,
    gaussians: Gaussians,
    mask: Tensor | None,
    camera: Camera,
    settings: RenderSettings,
    values: Callable[[], Tensor | None],
) -> LazyOutputs:
    """All outputs but the background; ``depth``, ``features`` and ``response`` are computed on access.

    ``images`` are of the Gaussians ``drawn``, those under ``mask``; mappings of these and of all must not change.
    ``features`` shows principal components as colours, ``response`` the ``values`` of the visible Gaussians ``[N]``.
    """
    alpha = images["accumulation"]

    def depth() -> Tensor:
        splatted: Any = splat(drawn, camera, drawn["opacities"], settings, render_depth=True).depth
        return torch.where(alpha > 0, splatted, splatted.max())  # empty pixels are farthest

    def features() -> Tensor:
        if settings.head is None:
            return alpha.new_zeros(*alpha.shape[:2], 3)
        image = splat(drawn, camera, drawn[FEATURES], settings).colors
        return feature_colors(image, *principal_components(gaussians[FEATURES]), alpha)

    def response_image() -> Tensor:
        if (responses := values()) is None:
            return torch.zeros_like(alpha)
        return splat(drawn, camera, (responses if mask is None else responses[mask])[:, None], settings).colors

    outputs = {**images, "depth": depth, "features": features, "response": response_image}
    return LazyOutputs({name: outputs[name] for name in OUTPUTS})


def empty_outputs(width: int, height: int, background: Tensor) -> dict[str, Any]:
    """Outputs of a crop without Gaussians, with the names and shapes of other outputs."""
    image = background.expand(height, width, 3)
    zeros = background.new_zeros(height, width, 1)
    images = (image, image, zeros + 10, zeros, background.new_zeros(height, width, 3), zeros)
    return {**dict(zip(OUTPUTS, images, strict=True)), "background": image}


def principal_components(features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean ``[F]``, first principal directions ``[F, 3]`` and standard deviations ``[3]`` of features ``[N, F]``."""
    mean = features.mean(dim=0)
    centred = features - mean
    variances, directions = torch.linalg.eigh(centred.T @ centred / max(len(features), 1))
    missing = (0, max(3 - features.shape[1], 0))
    directions = directions[:, -3:].flip(-1)
    # Signs are fixed, so that displayed colours are stable.
    signs = torch.where(directions.sum(dim=0) < 0, -1.0, 1.0)
    return mean, pad(directions * signs, missing), pad(variances[-3:].flip(-1).clamp_min(0).sqrt(), missing)


def feature_colors(features: Tensor, mean: Tensor, basis: Tensor, deviations: Tensor, alpha: Tensor) -> Tensor:
    """Rendered features ``[H, W, F]``, weighted by ``alpha``, as colours; [0, 1] are six deviations."""
    return ((features - alpha * mean) @ basis / (6 * deviations.clamp_min(1e-8)) + 0.5 * alpha).clamp(0, 1)


def response_values(response: Tensor) -> Tensor:
    """Rank of each response magnitude ``[N]``, scaled to (0, 1], float32; 0 where the response is not finite."""
    known = torch.isfinite(response)
    order = response[known].argsort().argsort()
    values = torch.zeros_like(response, dtype=torch.float32)
    values[known] = (order + 1).float() / max(int(known.sum()), 1)
    return values


class _Frame(NamedTuple):
    """A graph, the tensors that it reads and writes, the pairs that fit, and those of the last replay, int64 ``[]``."""

    graph: torch.cuda.CUDAGraph
    inputs: tuple[Tensor, Tensor, Tensor]  # world-to-camera, intrinsics and background
    images: dict[str, Tensor]
    capacity: int
    needed: Tensor


class FrameReplay:
    """Replays frames of one scene, which are recorded on demand and dropped when the Gaussians move in memory."""

    def __init__(self) -> None:
        self._frames: GraphCache[_Frame] = GraphCache()
        self._gaussians: object = None
        self._can_record = True
        # A viewer renders in its own thread; a replay and its inputs belong together.
        self._lock = Lock()

    def render(
        self, source: GaussianSource, camera: Camera, background: Tensor, settings: RenderSettings
    ) -> dict[str, Any]:
        """``rgb, base_rgb, accumulation`` of a view, each ``[H, W, C]``, as :func:`.render_view` makes them.

        Replays a recorded frame where possible: on CUDA by gsplat, without gradients, of all Gaussians in this process,
        from the third in a row of a size on. Other frames are the same up to the order of sums.
        """
        if self._can_record and _recordable(source, settings):
            with self._lock:
                try:
                    if (replayed := self._replayed(source, camera, background, settings)) is not None:
                        return replayed
                # No compiler, no memory, or any failure of a driver to record.
                except (BackendError, RuntimeError) as error:
                    _log.warning("frames cannot be recorded and are rendered kernel by kernel: %s", error)
                    _log.debug("", exc_info=True)
                    self._frames.clear()
                    self._can_record = False
        images = render_view(source, camera, background, settings, depth=False)[0]
        return {name: images[name] for name in REPLAYED}

    def _replayed(
        self, source: GaussianSource, camera: Camera, background: Tensor, settings: RenderSettings
    ) -> dict[str, Any] | None:
        record_frame = partial(_record, source, camera, background, settings)
        key = self._key(source, camera, settings)
        if (frame := self._frames.get(key, record_frame)) is None:
            return None
        images, needed = _replay(frame, camera, background)
        if needed > frame.capacity:
            frame = record_frame(capacity=int(SPARE_CAPACITY * needed))
            self._frames.put(key, frame)
            images, _ = _replay(frame, camera, background)
        return images

    def _key(self, source: GaussianSource, camera: Camera, settings: RenderSettings) -> object:
        """Key of a recorded frame: everything that the recording fixes. It reads the Gaussians at their addresses."""
        gaussians = source.gaussians
        addresses = tuple((name, value.data_ptr(), value.shape) for name, value in gaussians.items())
        if addresses != self._gaussians:
            self._frames.clear()
            self._gaussians = addresses
        head, plan = settings.head, scale_plan(camera, settings.trained_focal)
        # The network itself and not its id, which a later network could reuse.
        of_head = None if head is None else (head.net, head.addresses(), tuple(vars(head.config).values()), *plan)
        degree = min(gaussians.sh_degree, settings.active_sh_degree)
        return camera.width, camera.height, settings.antialiased, gaussians.encoding, degree, of_head


def _recordable(source: GaussianSource, settings: RenderSettings) -> bool:
    still = not settings.training and not torch.is_grad_enabled()
    return settings.backend.name == "gsplat" and source.replayable and still and source.gaussians.num_gaussians > 0


def _record(
    source: GaussianSource, camera: Camera, background: Tensor, settings: RenderSettings, capacity: int | None = None
) -> _Frame:
    """Record a frame with a capacity for tile and Gaussian pairs; by default measured on this view, with a reserve."""
    with torch.inference_mode(False), torch.no_grad():
        inputs = (camera.viewmat.clone(), camera.K.clone(), background.to(camera.viewmat).clone())
        here = camera._replace(viewmat=inputs[0], K=inputs[1])

        def run(pairs: Capacity) -> dict[str, Any]:
            limited = replace(settings, backend=RecordableGsplat(pairs))
            return render_view(source, here, inputs[2], limited, depth=False)[0]

        device = camera.viewmat.device
        if capacity is None:
            measured = Capacity()
            with warm_up(device):
                run(measured)
            capacity = int(SPARE_CAPACITY * max(int(needed) for needed in measured.needed)) + 1
        with warm_up(device):
            run(Capacity(capacity))

        def frame() -> tuple[dict[str, Any], Tensor]:
            pairs = Capacity(capacity)
            images = run(pairs)
            return {name: images[name] for name in REPLAYED}, torch.stack(pairs.needed).amax()

        graph, (images, needed) = record(frame, device)
    return _Frame(graph, inputs, images, capacity, needed)


def _replay(frame: _Frame, camera: Camera, background: Tensor) -> tuple[dict[str, Any], int]:
    """Images, and the number of pairs; the images are wrong if these exceed the capacity."""
    torch._foreach_copy_(list(frame.inputs), [camera.viewmat, camera.K, background.to(camera.viewmat)])
    frame.graph.replay()
    return {name: image.clone() for name, image in frame.images.items()}, int(frame.needed)
