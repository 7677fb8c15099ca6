"""Points from images with known cameras: planes are swept through each view and compared with its neighbours.

The sweep is that of Collins ("A Space-Sweep Approach to True Multi-Image Matching", 1996), with planes of several
directions (Gallup et al., 2007). Patches are compared by their normalised cross-correlation. A depth stays if it comes
back to its pixel through the depth that another view has found there.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate, normalize, pad

from sundae_ns.gpu.fused_sweep import Patches, correlate, sweep_kernels
from sundae_ns.gpu.nvrtc import Launch, kernels_where_possible
from sundae_ns.rendering.views import View
from sundae_ns.training.extension import Photo

WINDOW = 7
"""Side of the patches, pixels of the reduced images as all lengths here."""
CONTRAST = 0.02
"""Least standard deviation of the grey values of a patch: a flat one fits anywhere."""
LEAST_VARIANCE = 1e-5
"""Least variance of the grey values of a patch of another view, so that a flat one fits nothing."""
CORRELATION = 0.6
"""Least correlation with one of the views."""
NEIGHBORS = 3
"""Number of views that a view is compared with. The best one counts at a pixel, as often only one sees the place."""
CONFIRMING = 24
"""Number of views, in the same order, whose depths may agree with those of a view."""
JUDGES = 5000
"""Most sparse points, evenly drawn, that tell which views see the same places."""
STEP, FEWEST, MOST = 1.5, 16, 256
"""Pixels by which another view moves from plane to plane, and the limits of the number of planes."""
NEARER, FARTHER = 0.7, 4.0
"""Range of the depths, as shares of those of the nearest and farthest sparse points (without 2% on either side)."""
SEEN = 8
"""Fewest sparse points that state a range."""
LARGEST_ERROR, LARGEST_SHIFT = 0.1, 1.5
"""Largest relative difference of two depths that agree, and largest distance from the pixel that is come back to."""
STEEPEST = 0.15
"""Least cosine between the ray of a pixel and the normal of a plane."""
_TILT = 0.766, 0.643
"""Cosine and sine of 40 degrees, by which planes are turned."""
_BATCH = 16
"""Planes at a time."""


@dataclass(frozen=True)
class _Reduced:
    """A photo of reduced size; a capture of hundreds holds 12 bytes for each of their pixels."""

    view: View
    image: Tensor
    """uint8 ``[H, W, 3]``."""
    grey: Tensor
    """``[1, 1, H, W]``."""
    usable: Tensor
    """Pixels that count and have contrast, bool ``[H, W]``."""
    pose: Tensor
    """Camera-to-world, OpenCV axes ``[4, 4]``."""

    @property
    def rays(self) -> Tensor:
        """Points at depth 1 behind the middles of the pixels, camera coordinates ``[H, W, 3]``."""
        K, height, width = self.view.K, self.view.height, self.view.width
        x, y = (torch.arange(length, device=K.device) + 0.5 for length in (width, height))
        pixels = torch.stack([*torch.meshgrid(x, y, indexing="xy"), torch.ones(height, width, device=K.device)], dim=-1)
        return pixels.to(K) @ torch.linalg.inv(K).T


class _Neighbors(NamedTuple):
    """Indices of other views, by how much they tell about the depths of a view."""

    compared: list[int]
    confirming: list[int]


class Sweep:
    """The sweep through all views, one at a time.

    Args:
        photos: images and cameras; one in full size is held at a time.
        sparse: finite points of the scene that state the range of depths ``[P, 3]``.
        longest: longest side of the compared images, pixels.
    """

    def __init__(self, photos: Iterable[Photo], sparse: Tensor, longest: int) -> None:
        self.photos = [_reduced(photo, longest) for photo in photos]
        self._sparse = sparse
        self._neighbors = _neighbors(self.photos, sparse[:: -(-len(sparse) // JUDGES)] if len(sparse) else sparse)
        upward = [-photo.view.viewmat[1, :3] for photo in self.photos]
        self._up = torch.stack(upward).mean(dim=0) if upward else sparse.new_zeros(3)
        self._depths = [torch.zeros_like(photo.usable, dtype=torch.float32) for photo in self.photos]

    def add(self, index: int) -> Tensor:
        """Find the depths of a view ``[H, W]``, along its axis; 0 where there are none."""
        photo, others = self.photos[index], [self.photos[i] for i in self._neighbors[index].compared]
        limits = self._limits(photo.view)
        if limits is None or not others:
            return self._depths[index]
        low, high = limits
        best = torch.full_like(self._depths[index], -1.0)
        depth, rays = torch.zeros_like(best), photo.rays
        for normal in _directions(photo.view, self._up):
            # A plane is normal . X = 1 / s, so a pixel has the inverse depth facing * s.
            facing = rays @ normal
            steep = facing > STEEPEST * rays.norm(dim=-1)
            if not steep.any():
                continue
            ends = 1 / (high * float(facing[steep].max())), 1 / (low * float(facing[steep].min()))
            s = torch.linspace(*ends, _number_of_planes(photo, others, normal, ends), device=facing.device)
            score, place = _peaks(_correlations(photo, others, facing, s, (1 / high, 1 / low)))
            score = torch.where(steep, score, -1.0)
            found = 1 / (facing * (s[0] + place * (s[1] - s[0]))).clamp_min(1e-12)
            depth, best = torch.where(score > best, found, depth), torch.maximum(score, best)
        self._depths[index] = torch.where((best > CORRELATION) & photo.usable, depth, 0.0)
        return self._depths[index]

    def points(self) -> tuple[Tensor, Tensor]:
        """Points on which two or more views agree: positions ``[N, 3]`` and colours in [0, 1] ``[N, 3]``."""
        empty = self._sparse.new_zeros(0, 3)
        places, colours = zip((empty, empty), *(self._agreeing(index) for index in range(len(self.photos))))
        return torch.cat(places), torch.cat(colours)

    def _limits(self, view: View) -> tuple[float, float] | None:
        """Nearest and farthest depth to look at; None where too few sparse points are seen."""
        x, y, z = _project(view, self._sparse)
        seen = z[_in_view(view, x, y, z)].sort().values
        if len(seen) < SEEN:
            return None
        ends = seen[[int(0.02 * (len(seen) - 1)), int(0.98 * (len(seen) - 1))]].tolist()
        return NEARER * ends[0], FARTHER * ends[1]

    def _agreeing(self, index: int) -> tuple[Tensor, Tensor]:
        """Points of a view that others confirm: their means with those of the others, and colours."""
        photo, depth = self.photos[index], self._depths[index]
        chosen = depth > 0
        points = _to_world(photo, photo.rays[chosen] * depth[chosen][:, None])
        x, y, _ = _project(photo.view, points)
        total, count = points.clone(), torch.ones_like(x)
        for i in self._neighbors[index].confirming:
            other, depths = self.photos[i], self._depths[i]
            there_x, there_y, z = _project(other.view, points)
            column = there_x.nan_to_num().clamp(0, other.view.width - 1).long()
            row = there_y.nan_to_num().clamp(0, other.view.height - 1).long()
            found = depths[row, column]
            theirs = _to_world(other, other.rays[row, column] * found[:, None])
            back_x, back_y, _ = _project(photo.view, theirs)
            agrees = _in_view(other.view, there_x, there_y, z) & (found > 0) & ((found - z).abs() < LARGEST_ERROR * z)
            agrees &= torch.hypot(back_x - x, back_y - y) < LARGEST_SHIFT
            total += torch.where(agrees[:, None], theirs, 0.0)
            count += agrees
        good = count >= 2
        return total[good] / count[good][:, None], photo.image[chosen][good] / 255


def _reduced(photo: Photo, longest: int) -> _Reduced:
    view, image = photo.view, photo.target.permute(2, 0, 1)[None]
    mask = torch.ones_like(image[:, :1]) if photo.mask is None else photo.mask[None, None].to(image)
    if longest < max(view.width, view.height):
        view = view.zoomed(longest / max(view.width, view.height))
        image, mask = (
            interpolate(value, (view.height, view.width), mode="bilinear", antialias=True) for value in (image, mask)
        )
    grey = image.mean(dim=1, keepdim=True)
    size = _box(torch.ones_like(grey))
    deviation = (_box(grey * grey) / size - (_box(grey) / size) ** 2).clamp_min(0).sqrt()
    usable = (deviation > CONTRAST) & (_box(mask) / size > 0.99)
    colours = (255 * image[0].permute(1, 2, 0)).round().clamp(0, 255).to(torch.uint8)
    return _Reduced(view, colours, grey, usable[0, 0], torch.linalg.inv(view.viewmat))


def _project(view: View, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels x, y and depths of points ``[..., 3]``; pixels mean something where depths are positive."""
    x, y, z = ((points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]) @ view.K.T).unbind(dim=-1)
    return x / z, y / z, z


def _in_view(view: View, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Whether projected points lie in the image, in front of the camera, bool."""
    return (z > 0) & (x >= 0) & (y >= 0) & (x < view.width) & (y < view.height)


def _to_world(photo: _Reduced, points: Tensor) -> Tensor:
    return points @ photo.pose[:3, :3].T + photo.pose[:3, 3]


def _neighbors(photos: Sequence[_Reduced], sparse: Tensor) -> list[_Neighbors]:
    """For each view the others that see most of its sparse points, from directions that differ by some degrees."""
    if len(photos) < 2 or not len(sparse):
        return [_Neighbors([], []) for _ in photos]
    directions, seen = [], []
    for photo in photos:
        seen.append(_in_view(photo.view, *_project(photo.view, sparse)))
        directions.append(normalize(sparse - photo.pose[:3, 3], dim=-1))
    found = []
    for i in range(len(photos)):
        angles = [torch.rad2deg((directions[i] * other).sum(dim=-1).clamp(-1, 1).acos()) for other in directions]
        # Near directions tell little about depths; from far ones places look different.
        weights = [(angle / (angle + 4) * torch.exp(-((angle / 36) ** 2))) for angle in angles]
        shared = torch.stack([(weight * (seen[i] & other)).sum() for weight, other in zip(weights, seen)])
        shared[i] = -1
        order = torch.argsort(shared, descending=True, stable=True)[: len(photos) - 1].tolist()
        found.append(_Neighbors([j for j in order[:NEIGHBORS] if shared[j] > 0], order[:CONFIRMING]))
    return found


def _directions(view: View, up: Tensor) -> list[Tensor]:
    """Normals of the planes in camera coordinates, away from the camera: facing it, four turned ones, the ground."""
    c, s = _TILT
    fixed = [(0.0, 0.0, 1.0), (s, 0.0, c), (-s, 0.0, c), (0.0, s, c), (0.0, -s, c)]
    return [*(view.K.new_tensor(normal) for normal in fixed), view.viewmat[:3, :3] @ -normalize(up, dim=0)]


def _number_of_planes(photo: _Reduced, others: Sequence[_Reduced], normal: Tensor, ends: tuple[float, float]) -> int:
    """Number of planes between two, by the way that the middle of the image takes in the other views."""
    middle = photo.rays[photo.view.height // 2, photo.view.width // 2]
    points = _to_world(photo, torch.stack([middle / (torch.dot(middle, normal).clamp_min(STEEPEST) * s) for s in ends]))
    longest = 0.0
    for other in others:
        x, y, z = _project(other.view, points)
        if (z > 0).all():
            longest = max(longest, float(torch.hypot(x[1] - x[0], y[1] - y[0])))
    return int(min(max(longest / STEP, FEWEST), MOST))


def _correlations(
    photo: _Reduced, others: Sequence[_Reduced], facing: Tensor, s: Tensor, inverses: tuple[float, float]
) -> Tensor:
    """Highest correlation of patches with those of other views, by planes ``normal . X = 1 / s``: ``[S, H, W]``.

    It is -1 where no other view sees the place, and where its inverse depth lies outside ``inverses``.
    """
    grey = photo.grey
    size = _box(torch.ones_like(grey))
    mean = _box(grey) / size
    deviation = (_box(grey * grey) / size - mean * mean).clamp_min(1e-8).sqrt()
    # X' = R X + t with s normal . X = 1: the ray r goes to K (R r + s (normal . r) t).
    relatives = [other.view.viewmat @ photo.pose for other in others]
    ways = [other.view.K @ relative[:3] for other, relative in zip(others, relatives)]
    if kernels := _kernels(grey):
        pixels = torch.linalg.inv(photo.view.K)
        maps = torch.stack([torch.cat([way[:, :3] @ pixels, way[:, 3:]], dim=1) for way in ways])
        patches = Patches(*(value[0, 0] for value in (grey, size, mean, deviation)))
        return correlate(
            kernels, patches, facing, s, [other.grey[0, 0] for other in others], maps, inverses, LEAST_VARIANCE
        )
    lines = [(photo.rays @ way[:, :3].T, facing[..., None] * way[:, 3]) for way in ways]
    found = []
    for part in s.split(_BATCH):
        scores, inverse = [], facing * part[:, None, None]
        inside = (inverse >= inverses[0]) & (inverse <= inverses[1])
        for other, (start, slope) in zip(others, lines):
            x, y, z = (start[..., i] + part[:, None, None] * slope[..., i] for i in range(3))
            sides = z.new_tensor([other.view.width, other.view.height])
            grid = 2 * torch.stack([x, y], dim=-1) / (z.clamp_min(1e-6)[..., None] * sides) - 1
            valid = inside & (z > 1e-6) & (grid.abs() < 1).all(dim=-1)
            seen = grid_sample(
                other.grey.expand(len(part), -1, -1, -1), grid, padding_mode="border", align_corners=False
            )
            moments = _box(torch.cat([seen, seen * seen, seen * grey], dim=1)) / size
            average, square, product = moments.split(1, dim=1)
            variance = (square - average * average).clamp_min(LEAST_VARIANCE)
            score = (product - average * mean) / (deviation * variance.sqrt())
            scores.append(torch.where(valid, score[:, 0], -1.0))
        found.append(torch.stack(scores).amax(dim=0))
    return torch.cat(found)


def _kernels(image: Tensor) -> dict[str, Launch] | None:
    """The kernel for patches of :data:`WINDOW`, on a GPU that can have it."""
    if not image.is_cuda:
        return None
    return kernels_where_possible(_load, image.device, "a plane sweep takes some hundred kernels for each direction")


def _load(device: torch.device) -> dict[str, Launch]:
    return sweep_kernels(device, WINDOW)


def _peaks(scores: Tensor) -> tuple[Tensor, Tensor]:
    """Highest score of each pixel and its place among the planes, by a parabola through three of them: ``[H, W]``."""
    score, k = scores.max(dim=0)
    inner = k.clamp(1, len(scores) - 2)
    before, at, after = (scores.gather(0, inner[None] + i)[0] for i in (-1, 0, 1))
    curve = before - 2 * at + after
    shift = torch.where(curve < -1e-6, 0.5 * (before - after) / curve.clamp_max(-1e-6), 0.0).clamp(-0.5, 0.5)
    return score, k + torch.where((inner == k) & (before > -1) & (after > -1), shift, 0.0)


def _box(image: Tensor) -> Tensor:
    """Sum over the patch of each pixel ``[N, C, H, W]``; in few additions, as pooling is slow on a CPU."""
    image = pad(image, (WINDOW // 2,) * 4)
    for axis in (2, 3):
        length, power, size, offset = image.shape[axis] - WINDOW + 1, image, 1, 0
        total = image.new_zeros(())
        while size <= WINDOW:  # sums of 1, 2, 4 ... neighbours, joined by the binary digits of the window
            if WINDOW & size:
                total, offset = total + power.narrow(axis, offset, length), offset + size
            if 2 * size <= WINDOW:
                shorter = power.shape[axis] - size
                power = power.narrow(axis, 0, shorter) + power.narrow(axis, size, shorter)
            size *= 2
        image = total
    return image
