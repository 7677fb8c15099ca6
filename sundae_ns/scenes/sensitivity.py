"""What errors of a pack do to images, so that bits go where they are seen.

A camera sees a primitive from few directions, so some combinations of harmonics hardly show. Weights of the head differ
more: those of its finest level act on 64 times as many pixels as those of its coarsest. Derivatives of all pixels are
too many; with random signs r of the pixels, the mean square of the derivative of sum(r * image) is the sum of the squared
derivatives (Hutchinson, 1990). Views and signs are fixed, so that a run packs alike each time.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from sundae_ns.gaussians import FEATURES
from sundae_ns.model import SundaeModel
from sundae_ns.rasterization.harmonics import harmonic_basis
from sundae_ns.rendering.render import render
from sundae_ns.rendering.source import degree_in_use
from sundae_ns.scenes.statement import stored_view
from sundae_ns.storage.packing import Sensitivity

_VIEWS = 8
"""Rendered views."""
_PIXELS = 1 << 17
"""Pixels of a rendered view, at most."""
_PRIMITIVES = 1 << 14
"""Primitives whose directions count, at most."""


def sensitivity_of(model: SundaeModel, cameras: Mapping[str, Tensor]) -> Sensitivity:
    """Measure a model on the CPU in cameras of its capture.

    Args:
        model: of a finished run.
        cameras: as in :class:`sundae_ns.storage.packing.Scene`; at least one.
    """
    state = model.state
    rows = {}
    degree = degree_in_use(state.field.sh_degree, state.active_sh_degree)
    if degree > 0:
        rows["features_rest"] = torch.kron(_of_harmonics(state.field["means"].detach(), cameras, degree), torch.eye(3))
    head: dict[str, Tensor] = {}
    if model.head is not None and state.head_enabled:
        rows[FEATURES], head = _of_head(model, cameras)
    return Sensitivity(rows, head)


def _of_harmonics(means: Tensor, cameras: Mapping[str, Tensor], degree: int) -> Tensor:
    """Mean product of each pair of basis functions of degrees 1 and up, over the cameras that see a primitive ``[K, K]``."""
    chosen = means[:: -(-len(means) // _PRIMITIVES)]
    total = torch.zeros((degree + 1) ** 2 - 1, (degree + 1) ** 2 - 1, dtype=torch.float64)
    for i in range(len(cameras["poses"])):
        view = stored_view(cameras, i)
        x, y, z = (chosen @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]).T
        across, down = x / z * view.K[0, 0] + view.K[0, 2], y / z * view.K[1, 1] + view.K[1, 2]
        seen = chosen[(z > 0) & (across >= 0) & (across < view.width) & (down >= 0) & (down < view.height)]
        basis = harmonic_basis(degree, torch.nn.functional.normalize(seen - view.center, dim=1))[:, 1:].double()
        total += basis.T @ basis
    # A little of the identity: a form without any view is singular.
    return total + 1e-6 * (1 + total.trace()) * torch.eye(len(total), dtype=torch.float64)


@torch.enable_grad()  # type: ignore[untyped-decorator]
def _of_head(model: SundaeModel, cameras: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
    """Mean products of the derivatives by pairs of features ``[F, F]``, and mean squares of those by weights."""
    assert model.head is not None
    weights = {name: value for name, value in model.head.named_parameters() if value.ndim > 1}
    features = model.gauss_params[FEATURES]
    form = torch.zeros(features.shape[1], features.shape[1], dtype=torch.float64)
    squares = {name: torch.zeros(value.shape[:2], dtype=torch.float64) for name, value in weights.items()}
    signs = torch.Generator().manual_seed(0)
    count = len(cameras["poses"])
    for i in torch.linspace(0, count - 1, min(_VIEWS, count)).round().int().tolist():
        view = stored_view(cameras, i)
        if view.width * view.height > _PIXELS:
            view = view.zoomed((_PIXELS / (view.width * view.height)) ** 0.5)
        settings = model.render_settings(training=True)
        image = render(model.source, view, model.shown_background, settings, depth=False)[0]["rgb"]
        random = torch.randint(0, 2, image.shape, generator=signs) * 2.0 - 1
        of_features, *grads = torch.autograd.grad((image * random).sum(), [features, *weights.values()])
        form += of_features.double().T @ of_features.double()
        for name, grad in zip(weights, grads, strict=True):
            squares[name] += grad.double().square().flatten(2).mean(dim=2)
    return form, squares
