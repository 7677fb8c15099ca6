"""Points from images with known cameras: planes are swept through each view and compared with its neighbours.

The sweep is that of Collins ("A Space-Sweep Approach to True Multi-Image Matching", 1996), with planes of several
directions (Gallup et al., 2007). Patches are compared by their normalised cross-correlation. A depth stays if it comes
back to its pixel through the depth that another view has found there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate, normalize, pad

from sundae_ns.core.camera import Camera
from sundae_ns.cuda.kernels import kernels_where_possible
from sundae_ns.cuda.sweep import WINDOW, Patches, fused_correlations, sweep_kernels
from sundae_ns.train.state import Photo

CONTRAST = 0.02  # Least standard deviation of the grey values of a patch: a flat one fits anywhere
LEAST_VARIANCE = 1e-5  # Lower limit for the variance of a patch of another view, so that a flat one does not correlate
CORRELATION = 0.6  # Least correlation with one of the views
NEIGHBORS = 3  # Views that a view is compared with; the best one counts at a pixel, as often only one sees it
CONFIRMING = 24  # Number of best neighbours whose depths may confirm those of a view
JUDGES = 5000  # Most sparse points, evenly drawn, that decide which views are neighbours
PLANE_STEP, FEWEST_PLANES, MOST_PLANES = 1.5, 16, 256
"""Distance of two planes in another view, pixels of the reduced image, and the limits of the number of planes."""
NEARER, FARTHER = 0.7, 4.0
"""Range of the depths, as shares of those of the nearest and farthest sparse points (without 2% on either side)."""
SEEN = 8  # Fewest sparse points that state a range
LARGEST_ERROR, LARGEST_SHIFT = 0.1, 1.5
"""Largest relative difference of two depths that agree, and largest distance from the pixel that is come back to."""
STEEPEST = 0.15  # Least cosine between the ray of a pixel and the normal of a plane
_TURNED = ((0, 0, 1), (0.643, 0, 0.766), (-0.643, 0, 0.766), (0, 0.643, 0.766), (0, -0.643, 0.766))  # By 40 degrees
_BATCH = 16  # Planes at a time
_LOOKED_AT = 16  # Pixels examined for each wanted point: views do not agree on all, and even ones are chosen


@dataclass(frozen=True)
class _Reduced:
    """A photo of reduced size, 12 bytes a pixel with its depth: captures have hundreds."""

    camera: Camera
    image: Tensor  # uint8 [H, W, 3]
    grey: Tensor  # [1, 1, H, W]
    usable: Tensor  # Pixels that count and have contrast, bool [H, W]
    pose: Tensor  # Camera-to-world, OpenCV axes [4, 4]
    unproject: Tensor  # Inverse intrinsics [3, 3]

    def rays(self, row: Tensor, column: Tensor) -> Tensor:
        """Points at depth 1 behind pixel centres, camera coordinates ``[..., 3]``; rows and columns broadcast."""
        row, column = torch.broadcast_tensors(row, column)
        pixels = torch.stack([column + 0.5, row + 0.5, torch.ones_like(row)], dim=-1)
        return pixels.to(self.unproject) @ self.unproject.T


class Sweep:
    """The sweep through all views, one at a time, so that one photo in full size is held.

    ``sparse`` points of the scene ``[P, 3]``, finite, state the range of depths; ``longest`` is the longest side of the
    compared images, pixels.
    """

    def __init__(self, photos: Iterable[Photo], sparse: Tensor, longest: int) -> None:
        self.photos = [_reduced(photo, longest) for photo in photos]
        self._sparse = sparse
        self._neighbors = _neighbors(self.photos, sparse[:: -(-len(sparse) // JUDGES)] if len(sparse) else sparse)
        upward = [-photo.camera.viewmat[1, :3] for photo in self.photos]
        self._up = torch.stack(upward).mean(dim=0) if upward else sparse.new_zeros(3)
        self._depths = [torch.zeros_like(photo.usable, dtype=torch.float32) for photo in self.photos]

    def add(self, index: int) -> Tensor:
        """Find the depths of a view ``[H, W]``, along its axis; 0 where there are none."""
        photo, others = self.photos[index], [self.photos[i] for i in self._neighbors[index][0]]
        if (limits := self._limits(photo.camera)) is None or not others:
            return self._depths[index]
        low, high = limits
        best = torch.full_like(self._depths[index], -1.0)
        depth = torch.zeros_like(best)
        rows, columns = (torch.arange(side, device=best.device) for side in best.shape)
        rays = photo.rays(rows[:, None], columns)
        lengths = rays.norm(dim=-1)
        correlations = _correlations(photo, others, rays, (1 / high, 1 / low))
        # Normals of planes in camera coordinates, away from it: those that face it or nearly, and the ground's.
        for normal in [*photo.camera.K.new_tensor(_TURNED), photo.camera.viewmat[:3, :3] @ -normalize(self._up, dim=0)]:
            facing = rays @ normal  # of a plane normal . X = 1 / s a pixel has the inverse depth facing * s
            if not (steep := facing > STEEPEST * lengths).any():
                continue
            ends = 1 / (high * float(facing[steep].max())), 1 / (low * float(facing[steep].min()))
            planes = _number_of_planes(photo, others, normal, ends)
            s = torch.linspace(*ends, planes, dtype=facing.dtype, device=facing.device)
            score, plane = _peaks(correlations(facing, s))
            score = torch.where(steep, score, -1.0)
            candidate = 1 / (facing * (s[0] + plane * (s[1] - s[0]))).clamp_min(1e-12)
            depth, best = torch.where(score > best, candidate, depth), torch.maximum(score, best)
        self._depths[index] = torch.where((best > CORRELATION) & photo.usable, depth, 0.0)
        return self._depths[index]

    def points(self, wanted: int) -> tuple[Tensor, Tensor]:
        """Points on which two or more views agree: positions ``[N, 3]`` and colours in [0, 1] ``[N, 3]``.

        If there are many more than ``wanted``, pixels are skipped evenly.
        """
        empty = self._sparse.new_zeros(0, 3)
        every = max(1, sum(int((depth > 0).sum()) for depth in self._depths) // max(1, _LOOKED_AT * wanted))
        positions, colours = zip((empty, empty), *(self._agreeing(index, every) for index in range(len(self.photos))))
        return torch.cat(positions), torch.cat(colours)

    def _limits(self, camera: Camera) -> tuple[float, float] | None:
        """Nearest and farthest depth to look at; None where too few sparse points are seen."""
        x, y, z = _project(camera, self._sparse)
        depths = z[_in_view(camera, x, y, z)].sort().values
        if len(depths) < SEEN:
            return None
        ends = depths[[int(0.02 * (len(depths) - 1)), int(0.98 * (len(depths) - 1))]].tolist()
        return NEARER * ends[0], FARTHER * ends[1]

    def _agreeing(self, index: int, every: int) -> tuple[Tensor, Tensor]:
        """Points of one in ``every`` pixel that other views confirm: means with those of the others, and colours."""
        photo, depth = self.photos[index], self._depths[index]
        rows, columns = (depth > 0).nonzero()[::every].T
        points = _to_world(photo, photo.rays(rows, columns) * depth[rows, columns][:, None])
        x, y, _ = _project(photo.camera, points)
        total, count = points.clone(), torch.ones_like(x)
        for i in self._neighbors[index][1]:
            other, depths = self.photos[i], self._depths[i]
            there_x, there_y, z = _project(other.camera, points)
            column = there_x.nan_to_num().clamp(0, other.camera.width - 1).long()
            row = there_y.nan_to_num().clamp(0, other.camera.height - 1).long()
            other_depth = depths[row, column]
            theirs = _to_world(other, other.rays(row, column) * other_depth[:, None])
            back_x, back_y, _ = _project(photo.camera, theirs)
            agrees = _in_view(other.camera, there_x, there_y, z) & (other_depth > 0)
            agrees &= (other_depth - z).abs() < LARGEST_ERROR * z
            agrees &= torch.hypot(back_x - x, back_y - y) < LARGEST_SHIFT
            total += torch.where(agrees[:, None], theirs, 0.0)
            count += agrees
        good = count >= 2
        return total[good] / count[good][:, None], photo.image[rows, columns][good].float() / 255


def _reduced(photo: Photo, longest: int) -> _Reduced:
    camera, image = photo.camera, photo.target.permute(2, 0, 1)[None]
    mask = torch.ones_like(image[:, :1]) if photo.mask is None else photo.mask[None, None].to(image)
    if longest < max(camera.width, camera.height):
        camera = camera.zoomed(longest / max(camera.width, camera.height))
        size = (camera.height, camera.width)
        image, mask = (interpolate(value, size, mode="bilinear", antialias=True) for value in (image, mask))
    grey = image.mean(dim=1, keepdim=True)
    patches = _patches(grey)
    usable = (patches.deviation > CONTRAST) & (_box(mask)[0, 0] / patches.size > 0.99)
    colours = (255 * image[0].permute(1, 2, 0)).round().clamp(0, 255).to(torch.uint8)
    return _Reduced(camera, colours, grey, usable, torch.linalg.inv(camera.viewmat), torch.linalg.inv(camera.K))


def _patches(grey: Tensor) -> Patches:
    """The patches of an image ``[1, 1, H, W]``; flat ones have a small deviation, not none."""
    size = _box(torch.ones_like(grey))
    mean = _box(grey) / size
    deviation = (_box(grey * grey) / size - mean * mean).clamp_min(1e-8).sqrt()
    return Patches(*(value[0, 0] for value in (grey, size, mean, deviation)))


def _project(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels x, y and depths of points ``[..., 3]``; pixels mean something where depths are positive."""
    x, y, z = ((points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T).unbind(dim=-1)
    return x / z, y / z, z


def _in_view(camera: Camera, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Whether projected points lie in the image, in front of the camera, bool."""
    return (z > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)


def _to_world(photo: _Reduced, points: Tensor) -> Tensor:
    return points @ photo.pose[:3, :3].T + photo.pose[:3, 3]


def _neighbors(photos: Sequence[_Reduced], sparse: Tensor) -> list[tuple[list[int], list[int]]]:
    """For each view those that are compared with it, and those that confirm its depths; the best come first.

    They see most of its sparse points, from directions that differ by some degrees; views of one place tell no depths.
    """
    if len(photos) < 2 or not len(sparse):
        return [([], []) for _ in photos]
    visible = torch.stack([_in_view(photo.camera, *_project(photo.camera, sparse)) for photo in photos])
    directions = torch.stack([normalize(sparse - photo.pose[:3, 3], dim=-1) for photo in photos])
    neighbors = []
    for i, photo in enumerate(photos):
        both = visible & visible[i]
        angles = torch.rad2deg((directions * directions[i]).sum(dim=-1).clamp(-1, 1).acos())
        # Near directions tell little about depths, those within a pixel nothing; from far ones places look different.
        shared = (angles / (angles + 4) * torch.exp(-((angles / 36) ** 2)) * both).sum(dim=1)
        parallax = photo.camera.focal * torch.deg2rad(angles.masked_fill(~both, torch.nan).nanmedian(dim=1).values)
        shared[parallax < LARGEST_SHIFT] = shared[i] = -1
        order = torch.argsort(shared, descending=True, stable=True)[: int((shared >= 0).sum())].tolist()
        neighbors.append(([j for j in order[:NEIGHBORS] if shared[j] > 0], order[:CONFIRMING]))
    return neighbors


def _number_of_planes(photo: _Reduced, others: Sequence[_Reduced], normal: Tensor, ends: tuple[float, float]) -> int:
    """Number of planes between two, by the way that the middle of the image takes in the other views."""
    middle = photo.rays(*normal.new_tensor([photo.camera.height // 2, photo.camera.width // 2]))
    points = _to_world(photo, torch.stack([middle / (torch.dot(middle, normal).clamp_min(STEEPEST) * s) for s in ends]))
    longest = 0.0
    for other in others:
        x, y, z = _project(other.camera, points)
        if (z > 0).all():
            longest = max(longest, float(torch.hypot(x[1] - x[0], y[1] - y[0])))
    return int(min(max(longest / PLANE_STEP, FEWEST_PLANES), MOST_PLANES))


def _correlations(
    photo: _Reduced, others: Sequence[_Reduced], rays: Tensor, inverses: tuple[float, float]
) -> Callable[[Tensor, Tensor], Tensor]:
    """The function of :func:`.fused_correlations` for a view, its rays ``[H, W, 3]`` and its neighbours."""
    patches = _patches(photo.grey)
    # X' = R X + t with s normal . X = 1: the ray r projects to K (R r + s (normal . r) t).
    warps = [other.camera.K @ (other.camera.viewmat @ photo.pose)[:3] for other in others]
    slower = "a plane sweep runs as hundreds of kernels a direction"
    kernels = kernels_where_possible(sweep_kernels, photo.grey.device, slower)
    if kernels:
        maps = torch.stack([torch.cat([warp[:, :3] @ photo.unproject, warp[:, 3:]], dim=1) for warp in warps])
        images = [other.grey[0, 0] for other in others]
        return fused_correlations(kernels, patches, images, maps, inverses, LEAST_VARIANCE)
    starts = [rays @ warp[:, :3].T for warp in warps]
    return lambda facing, s: torch.cat(
        [_scores(patches, others, starts, warps, facing * batch[:, None, None], inverses) for batch in s.split(_BATCH)]
    )


def _scores(
    patches: Patches,
    others: Sequence[_Reduced],
    starts: Sequence[Tensor],
    warps: Sequence[Tensor],
    inverse: Tensor,
    inverses: tuple[float, float],
) -> Tensor:
    """What the kernel computes, by PyTorch's operations: scores ``[S, H, W]`` for inverse depths ``[S, H, W]``."""
    inside = (inverse >= inverses[0]) & (inverse <= inverses[1])
    scores = []
    for other, start, warp in zip(others, starts, warps):
        x, y, z = (start[..., i] + inverse * warp[i, 3] for i in range(3))
        sides = z.new_tensor([other.camera.width, other.camera.height])
        grid = 2 * torch.stack([x, y], dim=-1) / (z.clamp_min(1e-6)[..., None] * sides) - 1
        valid = inside & (z > 1e-6) & (grid.abs() < 1).all(dim=-1)
        grey = other.grey.expand(len(inverse), -1, -1, -1)
        warped = grid_sample(grey, grid, padding_mode="border", align_corners=False)
        moments = _box(torch.cat([warped, warped * warped, warped * patches.grey], dim=1)) / patches.size
        average, square, product = moments.unbind(dim=1)
        variance = (square - average * average).clamp_min(LEAST_VARIANCE)
        score = (product - average * patches.mean) / (patches.deviation * variance.sqrt())
        scores.append(torch.where(valid, score, -1.0))
    return torch.stack(scores).amax(dim=0)


def _peaks(scores: Tensor) -> tuple[Tensor, Tensor]:
    """Highest score of each pixel and the index of its plane, by a parabola through three of them: ``[H, W]``."""
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
        length = image.shape[axis] - WINDOW + 1
        power, total = image, image.new_zeros(())
        size, offset = 1, 0
        while size <= WINDOW:  # sums of 1, 2, 4 ... neighbours, joined by the binary digits of the window
            if WINDOW & size:
                total = total + power.narrow(axis, offset, length)
                offset += size
            if 2 * size <= WINDOW:
                shorter = power.shape[axis] - size
                power = power.narrow(axis, 0, shorter) + power.narrow(axis, size, shorter)
            size *= 2
        image = total
    return image
