"""Effect of quantisation errors on images, which decides where a pack spends its bits.

A camera sees a primitive from few directions, so some combinations of harmonics hardly show. Weights of the head differ
more: those of its finest level act on 64 times as many pixels as those of its coarsest. Derivatives of all pixels are
too many. With random signs r of the pixels, the mean square of the derivative of sum(r * image) is the sum of the
squared derivatives (Hutchinson, 1990). Views and signs are fixed, so that a run packs alike each time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from sundae_ns.api.scene import Scene
from sundae_ns.gaussians import FEATURES
from sundae_ns.rasterization.harmonics import harmonic_basis
from sundae_ns.rendering import LocalField, View
from sundae_ns.rendering.render import render_view
from sundae_ns.storage.pack import Sensitivity

_VIEWS = 8
"""Rendered views."""
_PIXELS = 1 << 17
"""Pixels of a rendered view, at most."""
_PRIMITIVES = 1 << 14
"""Primitives whose directions count, at most."""


def sensitivity_of(scene: Scene, views: Sequence[View]) -> Sensitivity:
    """Measure a scene on the CPU.

    Args:
        scene: on the CPU.
        views: at least one.
    """
    rows = {}
    degree = scene.field.sh_degree if scene.field.encoding == "harmonics" else 0
    if degree > 0:
        rows["features_rest"] = torch.kron(_of_harmonics(scene.field["means"].detach(), views, degree), torch.eye(3))
    head: dict[str, Tensor] = {}
    if scene.head is not None:
        rows[FEATURES], head = _of_head(scene, views)
    return Sensitivity(rows, head)


def _of_harmonics(means: Tensor, views: Sequence[View], degree: int) -> Tensor:
    """Sum of the products of basis functions of degrees 1 and up, over views and the primitives they see ``[K, K]``."""
    chosen = means[:: -(-len(means) // _PRIMITIVES)]
    total = torch.zeros((degree + 1) ** 2 - 1, (degree + 1) ** 2 - 1, dtype=torch.float64)
    for view in views:
        x, y, z = (chosen @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]).T
        across, down = x / z * view.K[0, 0] + view.K[0, 2], y / z * view.K[1, 1] + view.K[1, 2]
        seen = chosen[(z > 0) & (across >= 0) & (across < view.width) & (down >= 0) & (down < view.height)]
        basis = harmonic_basis(degree, torch.nn.functional.normalize(seen - view.center, dim=1))[:, 1:].double()
        total += basis.T @ basis
    # A little of the identity: a form without any view is singular.
    return total + 1e-6 * (1 + total.trace()) * torch.eye(len(total), dtype=torch.float64)


@torch.enable_grad()  # type: ignore[untyped-decorator]
def _of_head(scene: Scene, views: Sequence[View]) -> tuple[Tensor, dict[str, Tensor]]:
    """Mean products of the derivatives by pairs of features ``[F, F]``, and mean squares of those by weights."""
    assert scene.head is not None
    features = scene.field[FEATURES].detach().requires_grad_()
    source = LocalField(scene.field.replaced({FEATURES: features}))
    settings = replace(scene.settings(), training=True)
    weights = {name: value.requires_grad_() for name, value in scene.head.named_parameters() if value.ndim > 1}
    form = torch.zeros(features.shape[1], features.shape[1], dtype=torch.float64)
    squares = {name: torch.zeros(value.shape[:2], dtype=torch.float64) for name, value in weights.items()}
    signs = torch.Generator().manual_seed(0)
    for i in torch.linspace(0, len(views) - 1, min(_VIEWS, len(views))).round().int().tolist():
        view = views[i]
        if view.width * view.height > _PIXELS:
            view = view.zoomed((_PIXELS / (view.width * view.height)) ** 0.5)
        image = render_view(source, view, scene.background, settings, depth=False)[0]["rgb"]
        random = torch.randint(0, 2, image.shape, generator=signs) * 2.0 - 1
        of_features, *grads = torch.autograd.grad((image * random).sum(), [features, *weights.values()])
        form += of_features.double().T @ of_features.double()
        for name, grad in zip(weights, grads, strict=True):
            squares[name] += grad.double().square().flatten(2).mean(dim=2)
    return form, squares
