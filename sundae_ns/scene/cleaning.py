"""Cuts before a scene is published: a box, and floaters, which no surface supports."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.core.gaussians import sanitise
from sundae_ns.graph.neighbors import knn
from sundae_ns.scene.prune_scene import weights_in
from sundae_ns.scene.scene import Scene

if TYPE_CHECKING:
    from rich.console import Console

REACH = 3.0  # Gaussians touch if they are nearer than this many times the sum of their largest standard deviations


def crop(scene: Scene, low: Sequence[float], high: Sequence[float]) -> Scene:
    """The Gaussians whose centres are in a box, its faces included; everything else of the scene stays.

    Args:
        scene: to cut; it does not change.
        low: lowest x, y and z of the box, world units.
        high: highest x, y and z.

    Raises:
        ConfigError: the box is empty or not finite.
        DataError: no Gaussian is in the box.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(200, 3), torch.rand(200, 3))
    >>> sn.crop(scene, (0, 0, 0), (1, 1, 2)).num_gaussians
    200
    """
    return kept(scene, crop_mask(scene, low, high))


def remove_floaters(scene: Scene, *, cameras: Sequence[Camera] | None = None) -> Scene:
    """The scene without Gaussians that no surface supports.

    These are small groups that touch no other Gaussian, and what no camera sees. Floaters that touch a surface stay.

    Args:
        scene: to clean; it does not change.
        cameras: cameras of the photographs; by default those stored with the scene. Without any, groups alone count.

    Raises:
        DataError: no Gaussian is finite, or the cameras see none.

    >>> import torch, sundae_ns as sn
    >>> points = torch.cat([torch.rand(2000, 3), torch.tensor([[9.0, 9.0, 9.0]])])
    >>> scene = sn.Scene.from_points(points, torch.rand(2001, 3))
    >>> gaussians = scene.gaussians.replaced({"scales": scene.gaussians["scales"].clamp(max=-3)})
    >>> sn.remove_floaters(sn.Scene(gaussians)).num_gaussians < 2001
    True
    """
    return kept(scene, ~floater_mask(scene, scene.cameras if cameras is None else cameras))


def kept(scene: Scene, mask: Tensor) -> Scene:
    """The scene with the Gaussians under a mask, bool ``[N]``."""
    return dataclasses.replace(scene, gaussians=scene.gaussians.rows(mask))


def within(mask: Tensor | None, inner: Tensor) -> Tensor:
    """A mask ``[N]`` of which only the entries under ``inner`` ``[M]`` stay, for its M true ones; None is all true."""
    if mask is None:
        return inner
    narrowed = mask.clone()
    narrowed[mask] = inner
    return narrowed


def crop_mask(scene: Scene, low: Sequence[float], high: Sequence[float]) -> Tensor:
    """True for the Gaussians in a box, bool ``[N]``; arguments and errors as for :func:`crop`."""
    if len(low) != 3 or len(high) != 3 or not all(math.isfinite(value) for value in (*low, *high)):
        raise ConfigError("the box is not six finite numbers; give its lowest x y z, then its highest")
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise ConfigError("the box is empty; give its lowest x y z first, then its highest")
    means = scene.gaussians["means"].detach()
    lowest, highest = (means.new_tensor(corner, dtype=torch.float64) for corner in (low, high))
    inside = ((means.double() >= lowest) & (means.double() <= highest)).all(dim=1)  # exact in float64
    if not bool(inside.any()):
        finite = means[means.isfinite().all(dim=1)].double().cpu().numpy()
        if not len(finite):
            raise DataError("no Gaussian is in the box, because none is finite; export the scene again")
        low, high = np.quantile(finite, (0.05, 0.95), axis=0)
        corners = (" ".join(f"{value:.3g}" for value in corner) for corner in (low, high))
        raise DataError(f"no Gaussian is in the box; most of them lie between {' and '.join(corners)}")
    return inside


@torch.no_grad()
def floater_mask(scene: Scene, cameras: Sequence[Camera], *, console: Console | None = None) -> Tensor:
    """True for floaters, bool ``[N]``; arguments and errors as for :func:`remove_floaters`."""
    sanitised = sanitise(scene.gaussians)
    if not sanitised.gaussians.num_gaussians:
        raise DataError("no Gaussian is finite; export the scene again")
    usable = dataclasses.replace(scene, gaussians=sanitised.gaussians)
    floats = _unsupported(usable)
    if cameras:
        small = [camera.zoomed(min(512 / max(camera.width, camera.height), 1.0)) for camera in cameras]
        floats |= weights_in(usable, small, console=console) <= 0
    mask = ~sanitised.mask
    mask[sanitised.mask] = floats
    return mask


def _unsupported(scene: Scene) -> Tensor:
    """True for Gaussians of small groups that touch no other one, bool ``[N]``."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = scene.num_gaussians
    if n <= 1:
        return torch.zeros(n, dtype=torch.bool, device=scene.device)
    near = knn(scene.gaussians["means"].detach(), min(16, n - 1))
    reach = REACH * scene.gaussians["scales"].detach().amax(dim=1).exp()
    touching = near.distances < reach[:, None] + reach[near.indices]
    rows = torch.arange(n, device=scene.device)[:, None].expand_as(touching)[touching].cpu().numpy()
    columns = near.indices[touching].cpu().numpy()
    graph = coo_matrix((np.ones(len(rows), dtype=bool), (rows, columns)), shape=(n, n))
    groups = connected_components(graph, directed=False)[1]
    small = np.bincount(groups) <= max(1, min(30, n // 1000))
    return torch.from_numpy(small[groups]).to(scene.device)
