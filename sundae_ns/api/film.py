"""Cameras of a film: a closed, smooth path through the views of a scene, or around a scene without any."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from sundae_ns.api.rendering import render
from sundae_ns.api.scene import Scene
from sundae_ns.api.start import unit
from sundae_ns.api.virtual import FOV, loop_around
from sundae_ns.errors import ConfigError
from sundae_ns.rendering.views import View, poses_looking_at

KEYS = 8
"""Most views that the path leads through."""
MOST_FRAMES = 36_000
"""Frames of 25 minutes."""
LONGEST = 1280
"""Longest side of the images, pixels."""
_SIZE = (1280, 720)
"""Width and height of images of a scene without views, pixels."""
_ROUNDS = 10
"""Rounds in which the chosen views move to the middle of those nearest to them."""
_LEAST = 3
"""Fewest views that make a path."""
_STEEP = 0.95
"""A view that looks up or down by more than this cosine has no upright image, and is passed over."""
_OPPOSITE = -0.5
"""Cosine below which two directions are so far apart that the spline between them would flip."""
_SAMPLES = 64
"""Points of the spline between two views, by which its length is measured."""
_ASKED, _DEPTH_SIDE = 16, 48
"""Most images that tell how far away things are, and their longest side, pixels."""

Array = NDArray[np.float64]


def film_views(scene: Scene, *, seconds: float = 12.0, frames_per_second: float = 24.0) -> list[View]:
    """Cameras of a film of a scene, along a closed and smooth path at an even speed; upright, without roll.

    The path leads through some of the views that are stored with the scene, in an order that makes it short, and looks
    where they look; it begins with the start view, else with the first. A scene without views is seen from all around,
    or to and fro before it if it has a back side. The speed is that of motion and turning together.

    Args:
        scene: its up axis, else the mean of its views', else z, is upwards in the images.
        seconds: length of the film.
        frames_per_second: number of cameras a second.

    Returns:
        One camera a frame, with the field of view and the shape of the first view's images.

    Raises:
        ConfigError: there is not even one frame, or there are more than :data:`MOST_FRAMES`.
        DataError: the scene has no finite primitive.
    """
    count = round(seconds * frames_per_second) if math.isfinite(seconds * frames_per_second) else 0
    if not (1 <= count <= MOST_FRAMES and seconds > 0):
        raise ConfigError(
            f"a film of {seconds:g} s and {frames_per_second:g} frames a second is impossible; "
            f"give 1 to {MOST_FRAMES:,} frames"
        )
    up = _up_of(scene)
    views = [view for view in (scene.start, *scene.views) if view is not None]
    lens = views[0] if views else View.from_fov(torch.eye(4), FOV, *_SIZE)
    views = [view for view in views if abs(float(_ahead(view) @ up)) < _STEEP]
    chosen, distance = [], 1.0
    if len(views) >= _LEAST:
        places, ahead = (np.stack([part(view) for view in views]) for part in (_place, _ahead))
        distance = _distance(scene, views)
        chosen = _tour(np.hstack([places / distance, ahead]), KEYS)
    if len(chosen) >= _LEAST:
        places, ahead = places[chosen], ahead[chosen]
    else:
        loop = loop_around(scene, torch.from_numpy(up))
        places, arms = loop.eyes.numpy(), (loop.target - loop.eyes).numpy()
        distance = float(np.linalg.norm(arms[0]))
        ahead = arms / np.linalg.norm(arms, axis=1, keepdims=True)
    places, ahead = _even(*_with_turns(places, ahead, up), up, distance, count)
    eyes, targets = torch.from_numpy(places), torch.from_numpy(places + ahead)
    poses = poses_looking_at(eyes, targets, torch.from_numpy(up))
    lens = lens.zoomed(min(LONGEST / max(lens.width, lens.height), 1.0))
    intrinsics = [float(lens.K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2))]
    return [View.from_pose(pose, intrinsics, lens.width, lens.height) for pose in poses]


def _place(view: View) -> Array:
    found: Array = view.center.double().cpu().numpy()
    return found


def _ahead(view: View) -> Array:
    """The direction of view, of unit length ``[3]``."""
    back = view.pose[:, 2].double().cpu().numpy()
    found: Array = -back / np.linalg.norm(back)
    return found


def _up_of(scene: Scene) -> Array:
    up = scene.up
    if up is None and scene.views:
        mean = torch.stack([view.pose[:, 1] for view in scene.views]).double().mean(dim=0)
        up = unit(mean.tolist()) if float(mean.norm()) > 1e-3 else None
    return np.array(up or (0.0, 0.0, 1.0))


def _distance(scene: Scene, views: Sequence[View]) -> float:
    """The median distance of what views see; the unit in which the path measures motion against turning."""
    found = []
    for view in views[:: -(-len(views) // _ASKED)]:
        depth = render(scene, view.zoomed(_DEPTH_SIDE / max(view.width, view.height)), head=False).depth
        found.append(float(depth[depth > 0].median()) if bool((depth > 0).any()) else math.nan)
    if np.isnan(found).all():  # they see nothing, or only what is nearer than the near plane
        centers = np.stack([_place(view) for view in views])
        found = np.linalg.norm(centers - centers.mean(axis=0), axis=1).tolist()
    return max(float(np.nanmedian(found)), 1e-9)


def _tour(points: Array, most: int) -> list[int]:
    """Indices of points ``[N, C]`` along a short closed way: the first one, and at most ``most`` in all.

    Those are spread over all points: each is the middle one of the points that are nearest to it.
    """
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    chosen = [0]
    while len(chosen) < most and (far := apart[chosen].min(axis=0)).max() > 1e-6:
        chosen.append(int(far.argmax()))
    for _ in range(_ROUNDS):
        nearest = apart[chosen].argmin(axis=0)
        for k in range(1, len(chosen)):
            members = np.flatnonzero(nearest == k)
            if len(members):
                chosen[k] = int(members[apart[np.ix_(members, members)].sum(axis=0).argmin()])
    sizes = np.bincount(apart[chosen].argmin(axis=0), minlength=len(chosen))
    typical = sizes >= len(points) / len(chosen) / 3
    chosen = [index for k, index in enumerate(chosen) if k == 0 or typical[k]]
    return [chosen[i] for i in _short_way(apart[np.ix_(chosen, chosen)])]


def _short_way(apart: Array) -> list[int]:
    """An order of K points with distances ``[K, K]`` whose closed way no exchange of two parts makes shorter."""
    count = len(apart)
    way = [0]
    while len(way) < count:  # the nearest one next
        left = [i for i in range(count) if i not in way]
        way.append(min(left, key=lambda i: apart[way[-1], i]))
    better = True
    while better:
        better = False
        for i in range(1, count - 1):
            for j in range(i + 1, count):
                a, b, c, d = way[i - 1], way[i], way[j], way[(j + 1) % count]
                if apart[a, c] + apart[b, d] < apart[a, b] + apart[c, d] - 1e-12:
                    way[i : j + 1] = way[i : j + 1][::-1]
                    better = True
    return way


def _with_turns(places: Array, ahead: Array, up: Array) -> tuple[Array, Array]:
    """The knots of a closed way ``[K, 3]``, with one more, to the side, where two look in opposite directions."""
    found = []
    for i, here in enumerate(ahead):
        found.append((places[i], here))
        there, place = ahead[(i + 1) % len(ahead)], places[(i + 1) % len(ahead)]
        if here @ there < _OPPOSITE:
            side = np.cross(up, here - there)
            found.append(((places[i] + place) / 2, side / np.linalg.norm(side)))
    knots = np.array(found)
    return knots[:, 0], knots[:, 1]


def _even(places: Array, ahead: Array, up: Array, distance: float, count: int) -> tuple[Array, Array]:
    """Places and directions ``[count, 3]`` at an even speed on a smooth closed way through knots ``[K, 3]``."""
    knots = np.hstack([places / distance, ahead])
    knots = np.vstack([knots, knots[:1]])
    # Parameters of square roots of distances keep the spline from swinging out (centripetal).
    steps = np.sqrt(np.linalg.norm(np.diff(knots, axis=0), axis=1)).clip(1e-3)
    times = np.concatenate([[0.0], steps.cumsum()])
    spline = CubicSpline(times, knots, bc_type="periodic")

    def at(moments: Array) -> Array:
        found: Array = spline(moments)
        found[:, 3:] = _level(found[:, 3:], up)
        return found

    fine = np.linspace(0.0, times[-1], _SAMPLES * len(steps) + 1)
    lengths = np.concatenate([[0.0], np.linalg.norm(np.diff(at(fine), axis=0), axis=1).cumsum()])
    frames = np.arange(count) / count * lengths[-1]
    found = at(np.interp(frames, lengths, fine))
    return found[:, :3] * distance, found[:, 3:]


def _level(ahead: Array, up: Array) -> Array:
    """Directions ``[..., 3]`` of unit length, those too steep for an upright image brought down."""
    ahead = ahead / np.linalg.norm(ahead, axis=-1, keepdims=True).clip(1e-9)
    rise = (ahead @ up)[..., None]
    flat = ahead - rise * up
    rise = rise.clip(-_STEEP, _STEEP)
    level: Array = rise * up + np.sqrt(1 - rise**2) * flat / np.linalg.norm(flat, axis=-1, keepdims=True).clip(1e-9)
    return level
