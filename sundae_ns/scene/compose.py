"""A scene cut by a box, clean of floaters, or in other coordinates, and several scenes as one."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Iterable, Sequence

import torch
from rich.console import Console
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.core.covariance import rotation_matrices
from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.core.gaussians import FEATURES, Gaussians, concatenated, sanitise
from sundae_ns.core.values import AnyArray, numbers, positions
from sundae_ns.head.head import CompensationHead
from sundae_ns.io.coordinates import similarity
from sundae_ns.pruning.floaters import STRENGTH, floater_odds
from sundae_ns.scene.prune_scene import weights_in
from sundae_ns.scene.scene import Scene, unit, usable_cameras, within

_SIDE = 512  # longest side of the images that measure visibility, pixels; the next two were measured with it
_FAINT = 0.01  # weight as a share of the mean, below which a Gaussian is hardly seen; 0 tells captures apart less well
HARDLY_SEEN = 0.17  # share of such Gaussians: up to 0.10 in the captures tried, in other coordinates from 0.27 on
LEAST_SEEN = 0.92  # share of the Gaussians that cameras of a prune see, else they may be in other coordinates: a guess
# Logarithms of the least odds of a floater at strengths 0 and 1; by the root of the strength its default is half way.
_SURE, _DOUBTFUL = 2.0, -6.0
OTHERS = "if the cameras are not in the coordinates of the scene, give those of its own run or capture"
_log = logging.getLogger(__name__)


def transform(
    scene: Scene, rotation: AnyArray | None = None, scale: float = 1.0, translation: AnyArray = (0.0, 0.0, 0.0)
) -> Scene:
    """The scene moved by ``x -> scale * R x + translation``: Gaussians with their harmonics, cameras, start view, up.

    A head stays. ``cameras_of(path, scene)`` follows a run; a file of survey coordinates is moved in these.

    Args:
        scene: to move; it does not change.
        rotation: R as a matrix ``[3, 3]`` or a wxyz quaternion ``[4]``; none by default.
        scale, translation: factor of all lengths; world units ``[3]``.

    Raises:
        ConfigError, DataError: the matrix is no rotation, or the scale not positive; float32 is too coarse there.

    >>> import sundae_ns as sn
    >>> scene = sn.Scene.from_points([[1, 0, 0]], [[0.5, 0.5, 0.5]])
    >>> sn.transform(scene, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], 2.0, (0, 0, 5)).means
    tensor([[0., 2., 5.]])
    """
    turn = torch.eye(3, dtype=torch.float64) if rotation is None else numbers(rotation, "rotation", (3, 3), (4,))
    if turn.ndim == 1 and bool(turn.any()):
        turn = rotation_matrices(turn[None])[0]
    if turn.ndim == 1 or float((turn.mT @ turn - torch.eye(3)).abs().max()) > 1e-3 or float(turn.det()) < 0:
        raise ConfigError("rotation is no rotation; give a matrix of unit axes at right angles, or a wxyz quaternion")
    if not float(numbers(scale, "scale", ())) > 0:
        raise ConfigError(f"scale is {scale}; give a positive number")
    shift, meta = numbers(translation, "translation", (3,)), dict(scene.meta)
    if scene.offset is not None:
        # Gaussians near the origin stay there, for the digits of float32.
        offset = scale * turn @ torch.tensor(scene.offset, dtype=torch.float64) + shift
        shift = torch.zeros(3, dtype=torch.float64)
        meta["frame"] = {"transform": torch.cat([torch.eye(3), -offset[:, None]], dim=1).tolist(), "scale": 1.0}
    elif "frame" in meta:
        stated = torch.tensor(meta["frame"]["transform"], dtype=torch.float64)[:3]
        size = scale * meta["frame"]["scale"]
        stated = torch.cat([turn @ stated[:, :3], turn @ stated[:, 3:] + shift[:, None] / size], dim=1)
        meta["frame"] = {"transform": stated.tolist(), "scale": size}
    rigid = torch.cat([turn, shift[:, None] / scale], dim=1)
    moved = similarity({**scene.gaussians, "means": scene.means.double()}, rigid, float(scale))
    moved["means"] = positions(moved["means"], "the moved scene").to(scene.means)
    inverse = torch.cat([scale * rigid, torch.eye(4, dtype=torch.float64)[3:]]).inverse()
    sizes = torch.tensor([[scale]] * 3 + [[1.0]], dtype=torch.float64)  # of what a camera sees

    def moved_camera(camera: Camera) -> Camera:
        return camera._replace(viewmat=(sizes * camera.viewmat.double() @ inverse).to(camera.viewmat))

    return dataclasses.replace(
        scene,
        gaussians=scene.gaussians.replaced(moved),
        cameras=tuple(map(moved_camera, scene.cameras)),
        start=scene.start and moved_camera(scene.start),
        up=scene.up and unit(turn @ numbers(scene.up, "up", (3,))),
        in_model_frame=False,
        meta=meta,
    )


def merge(scenes: Iterable[Scene]) -> Scene:
    """Join scenes, at least one, in their order: Gaussians and stored cameras.

    All else is that of the first scene: device, background, start view, coordinates. Those of others are not changed
    (:func:`transform` does it), except for survey coordinates, which fit. Missing SH degrees are zero. A head stays if
    all scenes have the same one, as parts of a scene do.

    Raises:
        DataError: there is no scene, or heads, antialiasing, or the kinds of coordinates differ.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(50, 3), torch.rand(50, 3))
    >>> len(sn.merge([scene, sn.transform(scene, translation=(2, 0, 0))]))
    100
    """
    if not (scenes := list(scenes)) or not all(isinstance(scene, Scene) for scene in scenes):
        raise DataError("merge found no scenes; give a list of them")
    first = scenes[0]
    if not all(_same(first.head, scene.head) for scene in scenes):
        raise DataError("one head cannot correct scenes of others; give dataclasses.replace(scene, head=None) of each")
    if len({scene.antialiased for scene in scenes}) > 1:
        raise DataError("opacities of antialiased scenes mean less than those of others; train or export all alike")
    if len({scene.offset is None for scene in scenes}) > 1:
        raise DataError("some scenes have survey coordinates and others not; give dataclasses.replace(scene, meta={})")
    scenes = [aligned(scene, first) for scene in scenes]
    alike = len({scene.gaussians.encoding for scene in scenes}) == 1
    parts = [(scene.gaussians if alike else scene.gaussians.as_harmonics()).to(first.device) for scene in scenes]
    names = [name for name in first.gaussians if name != FEATURES or first.head is not None]
    return dataclasses.replace(
        first,
        gaussians=Gaussians(concatenated(parts, names), parts[0].encoding),
        cameras=tuple(dict.fromkeys(camera for scene in scenes for camera in scene.cameras)),  # parts share theirs
        up=first.up or next((scene.up for scene in scenes if scene.up), None),
    )


def aligned(scene: Scene, other: Scene) -> Scene:
    """The scene in the coordinates of another one, if they are survey coordinates with another offset."""
    if scene.offset is None or scene.offset == other.offset:
        return scene
    apart = numbers(scene.offset, "offset", (3,)) - numbers(other.offset or (0, 0, 0), "offset", (3,))
    return transform(dataclasses.replace(scene, meta={}), translation=apart)


def _same(head: CompensationHead | None, other: CompensationHead | None) -> bool:
    if head is None or other is None or head is other:
        return head is other
    pairs = zip(head.state_dict().values(), other.state_dict().values())
    return head.config == other.config and all(torch.equal(value.cpu(), its.cpu()) for value, its in pairs)


def crop(scene: Scene, low: AnyArray, high: AnyArray) -> Scene:
    """Keep the Gaussians with centres in a box, its faces included. Head and cameras stay.

    Args:
        scene: to cut; it does not change.
        low, high: lowest and highest x, y and z of the box, in the coordinates of the scene's file.

    Raises:
        ConfigError: the box is empty or not finite.
        DataError: no Gaussian is in the box.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(200, 3), torch.rand(200, 3))
    >>> sn.crop(scene, (0, 0, 0), (1, 1, 2)).num_gaussians
    200
    """
    return scene[crop_mask(scene, low, high)]


def remove_floaters(
    scene: Scene, strength: float = STRENGTH, *, cameras: Camera | Iterable[Camera] | None = None
) -> Scene:
    """Remove floating and unseen Gaussians.

    Args:
        scene: to clean; it does not change.
        strength: from 0, only what is certain to float, to 1, all that may; see :func:`.floater_odds`.
        cameras: cameras of the photographs; by default those stored with the scene. Without any, neighbours decide.

    Raises:
        ConfigError: the strength is not from 0 to 1.
        DataError: no Gaussian is finite, or the cameras see none.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(2000, 3), torch.full((2000, 3), 0.5))
    >>> sn.remove_floaters(scene).num_gaussians > 1900
    True
    """
    return scene[~floater_mask(scene, scene.cameras if cameras is None else usable_cameras(cameras), strength)]


def crop_mask(scene: Scene, low: AnyArray, high: AnyArray) -> Tensor:
    """True for the Gaussians in a box, bool ``[N]``; arguments and errors as for :func:`crop`."""
    means = means_in_file(scene)
    lowest, highest = (numbers(corner, "a corner of the box", (3,)).to(means.device) for corner in (low, high))
    if not bool((lowest < highest).all()):
        raise ConfigError("the box is empty; give its lowest x y z first, then its highest")
    inside = ((means >= lowest) & (means <= highest)).all(dim=1)
    if not bool(inside.any()):
        most = " ".join(f"{side:.15g}" for side in box_of(means, torch.ones_like(means[:, 0]), 0.9))
        raise DataError(f"no Gaussian is in the box; 90% of them are in {most}")
    return inside


def means_in_file(scene: Scene) -> Tensor:
    """Centres in the coordinates of the scene's file, also those of a survey: float64 ``[N, 3]``."""
    means = scene.means.detach().double()
    return means + means.new_tensor(scene.offset or (0.0, 0.0, 0.0))


def box_of(means: Tensor, weights: Tensor, share: float = 0.99) -> list[float]:
    """A box, lowest and highest x, y and z, that holds at least a share of weights ``[N]`` at centres ``[N, 3]``.

    Each face cuts off at most a sixth of the rest. Numbers are rounded outwards, by a thousandth of the longest side.
    """
    values, order = means.sort(dim=0)
    sums = weights[order].double().cumsum(0).T.contiguous()
    cut = sums[:, -1:] * (1 - share) / 6
    sides = values.T.gather(1, torch.searchsorted(sums, torch.cat([cut, sums[:, -1:] - cut], dim=1))).tolist()
    digits = 3 - math.floor(math.log10(max(high - low for low, high in sides) or 1.0))
    low = [round(math.floor(low * 10.0**digits) / 10.0**digits, digits) for low, _ in sides]
    return low + [round((math.floor(high * 10.0**digits) + 1) / 10.0**digits, digits) for _, high in sides]  # not flat


def for_cleaning(cameras: Sequence[Camera]) -> list[Camera]:
    """The cameras with images of at most 512 pixels a side, which suffice to tell whether a Gaussian is seen."""
    return [camera.zoomed(min(_SIDE / max(camera.width, camera.height), 1.0)) for camera in cameras]


@torch.no_grad()
def floater_mask(
    scene: Scene, cameras: Sequence[Camera], strength: float = STRENGTH, console: Console | None = None
) -> Tensor:
    """True for floaters, bool ``[N]``; arguments and errors as for :func:`remove_floaters`."""
    if not 0 <= strength <= 1:
        raise ConfigError(f"the strength of remove-floaters is {strength}; give 0 (careful) to 1 (thorough)")
    if not (sanitised := sanitise(scene.gaussians)).gaussians.num_gaussians:
        raise DataError("no Gaussian is finite; export the scene again")
    floats = floater_odds(sanitised.gaussians) > _SURE + (_DOUBTFUL - _SURE) * strength**0.5
    if cameras:
        usable = dataclasses.replace(scene, gaussians=sanitised.gaussians)
        weights = weights_in(usable, for_cleaning(cameras), console=console)
        if (share := float((weights < _FAINT * weights.mean()).float().mean())) > HARDLY_SEEN:
            _log.warning("the cameras hardly see %.0f%% of the Gaussians; %s", 100 * share, OTHERS)
        floats |= weights <= 0
    return ~within(sanitised.mask, ~floats)
