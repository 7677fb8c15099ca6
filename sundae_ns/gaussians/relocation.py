"""Moves of "3D Gaussian Splatting as Markov Chain Monte Carlo" (Kheradmand et al., 2024): relocation, growth, noise.

A primitive that becomes N primitives at its own place must look as before. With opacities ``o' = 1 - (1 - o)^(1/N)`` the
centre does; its width follows from asking that a ray's integral stays the same (equation 9 there). The double sum over
binomials is one sum, since ``sum_{i=1..N} C(i-1, k) = C(N, k+1)``:

    sigma' = sigma * o / sum_{j=1..N} C(N, j) (-1)^(j-1) o'^j / sqrt(j)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.nn.functional import normalize
from torch.optim import Optimizer

from sundae_ns.gaussians.surgery import replace_parameter

MAX_COPIES = 51
"""Copies beyond these are counted as these: the sum alternates, and its terms grow."""


def split_evenly(opacities: Tensor, scales: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and size of each of ``copies`` primitives that together look like one.

    Args:
        opacities: in (0, 1) ``[M]``.
        scales: standard deviations, any unit ``[M, 3]``.
        copies: how many there will be, the first included, at least 1 ``[M]``.

    Returns:
        Opacities ``[M]`` and scales ``[M, 3]``, of the dtype given.
    """
    n = copies.clamp(1, MAX_COPIES).to(torch.float64)
    old = opacities.to(torch.float64)
    new = 1 - (1 - old) ** (1 / n)
    j = torch.arange(1, MAX_COPIES + 1, dtype=torch.float64, device=old.device)
    table = torch.tensor(
        [[math.comb(size, order) for order in range(1, MAX_COPIES + 1)] for size in range(MAX_COPIES + 1)],
        dtype=torch.float64,
        device=old.device,
    )
    signs = torch.where(j % 2 == 1, 1.0, -1.0)
    total = (table[n.long()] * signs * new[:, None] ** j / j.sqrt()).sum(dim=1)
    return new.to(opacities), scales * (old / total)[:, None].to(scales)


def draw(weights: Tensor, count: int) -> Tensor:
    """Indices ``[count]`` drawn with replacement in proportion to ``weights`` ``[M]``; from torch's own generator.

    By inversion in float64, since ``torch.multinomial`` takes no more than 2^24 weights.
    """
    cumulative = weights.to(torch.float64).cumsum(dim=0)
    uniform = torch.rand(count, dtype=torch.float64, device=weights.device) * cumulative[-1]
    return torch.searchsorted(cumulative, uniform, right=True).clamp_max(len(weights) - 1)


@torch.no_grad()
def relocate(
    params: MutableMapping[str, Parameter], optimizers: Mapping[str, Optimizer], dead: Tensor, min_opacity: float
) -> int:
    """Move dead primitives onto living ones, drawn by opacity, so that the picture stays as it was.

    Args:
        params: the field; its values change, its parameters stay the same objects.
        optimizers: the moments of all primitives that take part become 0.
        dead: True for those to move, bool ``[N]``.
        min_opacity: no opacity gets below this.

    Returns:
        How many were moved; 0 also where none is alive.
    """
    targets, alive = dead.nonzero().squeeze(1), (~dead).nonzero().squeeze(1)
    if len(targets) == 0 or len(alive) == 0:
        return 0
    sources = alive[draw(params["opacities"][alive].sigmoid().flatten(), len(targets))]
    _share(params, sources, min_opacity)
    for name, value in params.items():
        value.data[targets] = value.data[sources]
        for moment in _per_row(optimizers.get(name), value).values():
            moment[sources] = 0
            moment[targets] = 0
    return len(targets)


@torch.no_grad()
def grow(
    params: MutableMapping[str, Parameter], optimizers: Mapping[str, Optimizer], count: int, min_opacity: float
) -> None:
    """Add ``count`` primitives on top of others, drawn by opacity, so that the picture stays as it was.

    Parameters are new objects afterwards, as after :func:`sundae_ns.gaussians.surgery.keep`.
    """
    if count <= 0:
        return
    sources = draw(params["opacities"].sigmoid().flatten(), count)
    _share(params, sources, min_opacity)
    for name, value in list(params.items()):
        new = Parameter(torch.cat([value.data, value.data[sources]]), requires_grad=value.requires_grad)
        optimizer = optimizers.get(name)
        held = {} if optimizer is None else optimizer.state.get(value, {})
        longer = {
            key: torch.cat([moment, torch.zeros_like(moment[sources])])
            for key, moment in _per_row(optimizer, value).items()
        }
        replace_parameter(params, optimizers, name, new, {**held, **longer})


@torch.no_grad()
def jitter(params: Mapping[str, Tensor], strength: float) -> None:
    """Move centres by noise of each primitive's own shape: transparent ones much, opaque ones hardly at all.

    Args:
        params: the field; its centres change.
        strength: of the noise; the paper's is 5e5 times the learning rate of the centres.
    """
    means, scales = params["means"], params["scales"].exp()
    gate = torch.sigmoid(100 * (0.005 - params["opacities"].sigmoid()))  # 1 below an opacity of 0.005, 0 above
    rotation = _matrices(normalize(params["quats"], dim=-1))
    noise = torch.randn_like(means) * gate * strength
    # Covariance times noise, R S^2 R^T e, without building it.
    local = torch.einsum("nji,nj->ni", rotation, noise) * scales.square()
    means.data.add_(torch.einsum("nij,nj->ni", rotation, local))


def _share(params: Mapping[str, Tensor], sources: Tensor, min_opacity: float) -> None:
    """Give each source the opacity and size of one of as many as it was drawn times, and itself."""
    times = torch.bincount(sources, minlength=len(params["means"]))
    chosen = times.nonzero().squeeze(1)
    opacities, scales = split_evenly(
        params["opacities"][chosen].sigmoid().flatten(), params["scales"][chosen].exp(), times[chosen] + 1
    )
    eps = torch.finfo(opacities.dtype).eps
    params["opacities"].data[chosen] = torch.logit(opacities.clamp(min_opacity, 1 - eps))[:, None]
    params["scales"].data[chosen] = scales.log()


def _per_row(optimizer: Optimizer | None, value: Tensor) -> dict[str, Tensor]:
    state = {} if optimizer is None else optimizer.state.get(value, {})
    return {
        key: moment
        for key, moment in state.items()
        if key != "step" and isinstance(moment, Tensor) and moment.shape == value.shape
    }


def _matrices(quats: Tensor) -> Tensor:
    """Rotation matrices ``[N, 3, 3]`` of unit quaternions wxyz ``[N, 4]``."""
    w, x, y, z = quats.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)
