"""The reference rasteriser: plain PyTorch, any device, float32 or float64; the oracle of the other backends.

EWA splatting (Zwicker et al., "EWA Splatting", 2002) with the conventions and thresholds of gsplat 1.4's CUDA kernels.
The perspective map is linearised at the centre. Its slope is clamped to the image plus 0.15 of its size on each side.
Every footprint is blurred by 0.3 square pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import pi, sqrt
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize
from torch.utils.checkpoint import checkpoint

from sundae_ns.core.covariance import rotation_matrices
from sundae_ns.rasterize.types import Inputs, Rasterization, check_memory, check_pairs, result_of

BLUR = 0.3  # Variance in square pixels added to each footprint
FOV_MARGIN = 0.3
MAX_RADIUS = 1e9  # keeps radii within int32
BIN = 16  # Side of gsplat's tiles, pixels: a Gaussian is blended in all tiles that its three-sigma square touches
MIN_ALPHA = 1.0 / 255.0  # Contributions fainter than this are skipped
MAX_ALPHA = 0.999  # Upper bound of alpha, so that no single Gaussian makes a pixel opaque
MIN_TRANSMITTANCE = 1e-4
"""A pixel is finished when its next Gaussian would leave no more transmittance than this; that one is not blended."""

_SEGMENT = 4096  # list entries of a tile that are blended at once
_FAINTEST = -20.0  # lower bound of exponents, far below log(1 / 255): exp() is ten times slower on denormals


class ReferenceBackend:
    """Autograd projection and blending, tile by tile."""

    name = "reference"

    def rasterize(self, inputs: Inputs) -> Rasterization:
        """Render one view."""
        return blended(inputs, project(inputs), composite)

    def spherical_harmonics(self, degree: int, directions: Tensor, first: Tensor, rest: Tensor) -> Tensor:
        """See :meth:`.Backend.spherical_harmonics`."""
        basis = harmonic_basis(degree, normalize(directions, dim=-1))
        return (basis[..., None] * torch.cat([first[:, None], rest], dim=1)[:, : basis.shape[-1]]).sum(dim=-2)


# ---------------------------------------------------------------------------------------------------------- projection


@dataclass(frozen=True)
class Projection:
    """N Gaussians on the screen, in pixels; entries of culled ones (radius 0) are finite and meaningless."""

    means2d: Tensor  # [N, 2]
    covars2d: Tensor  # [N, 3]: xx, xy, yy after the blur
    conics: Tensor  # [N, 3]: the inverse of the covariance, xx, xy, yy
    depths: Tensor  # [N]: camera z
    compensations: Tensor  # [N]: square root of the ratio of determinants before and after the blur
    radii: Tensor  # [N], int32


def project(inputs: Inputs) -> Projection:
    """Project Gaussians into a pinhole view."""
    viewmat, K, width, height, _ = inputs.camera
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    camera = inputs.means @ rotation.T + translation
    z = camera[:, 2]
    in_range = (z >= inputs.near_plane) & (z <= inputs.far_plane) & (z > 0)
    # Replace culled centres first: where() alone would still pass NaN from 1 / z to the gradients.
    camera = torch.where(in_range[:, None], camera, camera.new_tensor([0.0, 0.0, 1.0]))
    x, y, z = camera.unbind(-1)

    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)

    # A 3x3 root of the covariance maps the unit sphere to the Gaussian; the root's two screen rows map it to the
    # footprint.
    root = (rotation @ rotation_matrices(inputs.quats)) * inputs.scales[:, None, :]
    slope_x = _limit_slope(x / z, fx, cx, width)
    slope_y = _limit_slope(y / z, fy, cy, height)
    row_x = (fx / z)[:, None] * (root[:, 0] - slope_x[:, None] * root[:, 2])
    row_y = (fy / z)[:, None] * (root[:, 1] - slope_y[:, None] * root[:, 2])
    xx, xy, yy = (row_x * row_x).sum(-1), (row_x * row_y).sum(-1), (row_y * row_y).sum(-1)

    # Lagrange's identity: a sum of squares, where xx * yy - xy * xy would cancel for thin Gaussians.
    sharp_det = torch.linalg.cross(row_x, row_y).square().sum(-1)
    det = sharp_det + BLUR * (xx + yy) + BLUR * BLUR
    xx, yy = xx + BLUR, yy + BLUR
    conics = torch.stack([yy, -xy, xx], dim=-1) / det[:, None]

    ratio = sharp_det / det
    positive = ratio > 0
    compensations = torch.where(positive, torch.where(positive, ratio, 1.0).sqrt(), 0.0)

    # Three standard deviations of the longer axis, rounded up; 0 where that square does not touch the image.
    with torch.no_grad():
        spread = (0.25 * (xx - yy).square() + xy * xy).clamp(min=0.01).sqrt()
        radii = torch.ceil(3.0 * (0.5 * (xx + yy) + spread).sqrt()).clamp(max=MAX_RADIUS)
        inside = (means2d + radii[:, None] > 0) & (means2d - radii[:, None] < means2d.new_tensor([width, height]))
        # Not by a product, in which NaN times 0 stays NaN.
        radii = torch.where(inside.all(dim=-1) & in_range, radii, 0).to(torch.int32)
    return Projection(means2d, torch.stack([xx, xy, yy], dim=-1), conics, camera[:, 2], compensations, radii)


def _limit_slope(slope: Tensor, focal: Tensor, centre: Tensor, size: int) -> Tensor:
    margin = FOV_MARGIN * 0.5 * size / focal
    return torch.clamp(slope, min=-centre / focal - margin, max=(size - centre) / focal + margin)


# ------------------------------------------------------------------------------------------------------------ blending


def blended(inputs: Inputs, projection: Projection, composite: Callable[..., tuple[Tensor, Tensor]]) -> Rasterization:
    """The result of a view, of what a backend has projected and its function as :func:`composite`."""
    opacities = inputs.opacities * projection.compensations if inputs.antialiased else inputs.opacities
    colors = inputs.colors
    if inputs.render_depth:
        colors = torch.cat([colors, projection.depths[:, None]], dim=1)
    means2d, size = projection.means2d[None], (inputs.camera.width, inputs.camera.height)
    image, alpha = composite(means2d, projection, opacities, colors, size, absgrad=inputs.absgrad)
    return result_of(image, alpha, means2d, projection.radii, inputs)


def composite(
    means2d: Tensor, projection: Projection, opacities: Tensor, colors: Tensor, size: tuple[int, int], *, absgrad: bool
) -> tuple[Tensor, Tensor]:
    """Blend opacities ``[N]`` and channels ``[N, C]`` to an image ``[H, W, C]`` and its alpha ``[H, W, 1]``.

    ``means2d`` are centres in pixels ``[1, N, 2]``, ``size`` is width and height. With ``absgrad`` the backward pass
    sets their ``absgrad`` ``[1, N, 2]``: absolute gradients of each pixel by the centre, summed (Ye et al., 2024).
    ``MemoryExhaustedError`` if a CPU's lists of tiles are too long.
    """
    width, height = size
    columns, rows = -(-width // BIN), -(-height // BIN)
    drawn = (projection.radii > 0) & (opacities >= MIN_ALPHA) & projection.conics.isfinite().all(dim=1)
    ids = drawn.nonzero()[:, 0]
    ids = ids[projection.depths[ids].argsort(stable=True)]
    centres, radii = means2d[0, ids].detach(), projection.radii[ids, None].to(means2d.dtype)
    first, beyond = ((centres - radii) / BIN).floor(), ((centres + radii) / BIN).ceil()
    if not means2d.is_cuda:
        spans = (beyond.minimum(beyond.new_tensor([columns, rows])) - first.clamp(min=0)).clamp(min=0)
        pairs = int(spans.prod(dim=1).sum())
        if means2d.requires_grad:  # the backward pass needs them all
            check_memory(100 * pairs, f"{pairs:,} pairs of a tile and a Gaussian")
        else:
            check_pairs(pairs, len(ids), columns * rows)

    channels = torch.cat([colors, torch.ones_like(colors[:, :1])], dim=1)  # ones blend to alpha
    absolute = torch.zeros_like(means2d) if absgrad else None
    values = (means2d[0], projection.conics, opacities, channels)
    tiles = []
    for row in range(rows):
        in_row = ((first[:, 1] <= row) & (row < beyond[:, 1])).nonzero()[:, 0]
        for column in range(columns):
            touched = in_row[(first[in_row, 0] <= column) & (column < beyond[in_row, 0])]
            tiles.append(_blend_tile(ids[touched], column * BIN, row * BIN, values, absolute))
    blended = torch.stack(tiles).reshape(rows, columns, BIN, BIN, -1).transpose(1, 2)
    blended = blended.reshape(rows * BIN, columns * BIN, -1)[:height, :width]
    if absolute is not None:
        means2d.absgrad = absolute  # type: ignore[attr-defined]
        if blended.requires_grad:

            def restart(_: Tensor) -> None:  # each backward pass sums anew
                absolute.zero_()

            blended.register_hook(restart)
    return blended[..., :-1], blended[..., -1:]


def _blend_tile(
    ids: Tensor, left: int, top: int, values: tuple[Tensor, Tensor, Tensor, Tensor], absolute: Tensor | None
) -> Tensor:
    """Channels of a tile's pixels ``[P, C]`` from its Gaussians, nearest first, whose ``values`` are those of all N."""
    steps = torch.arange(BIN, dtype=values[0].dtype, device=ids.device) + 0.5
    pixels = torch.stack([steps.repeat(BIN) + left, steps.repeat_interleave(BIN) + top])  # [2, P]
    blended: Any = 0
    through = torch.ones_like(pixels[:1])
    for chunk in ids.split(_SEGMENT):
        if (through <= MIN_TRANSMITTANCE).all():
            break
        segment = partial(_blend_segment, chunk, absolute)
        arguments = (pixels, through, *(value[chunk] for value in values))
        # Evaluate the pixels again in the backward pass, because all alphas of an image may exceed the memory.
        if torch.is_grad_enabled():
            added, through = checkpoint(segment, *arguments, use_reentrant=False, preserve_rng_state=False)
        else:
            added, through = segment(*arguments)
        blended = blended + added
    return blended


def _blend_segment(
    ids: Tensor, absolute: Tensor | None, pixels: Tensor, through: Tensor, *values: Tensor
) -> tuple[Tensor, Tensor]:
    """Blend M Gaussians: their part of the channels ``[P, C]``, and the transmittance behind them ``[1, P]``."""
    centres, conics, opacities, channels = values
    dx, dy = pixels[0] - centres[:, :1], pixels[1] - centres[:, 1:]
    if absolute is not None and dx.requires_grad:
        for axis, offset in enumerate((dx, dy)):
            offset.register_hook(lambda gradient, axis=axis: _add_absolute(gradient, absolute[0, :, axis], ids))
    xx, xy, yy = conics[:, :1], conics[:, 1:2], conics[:, 2:]
    exponents = -0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy
    alphas = (opacities[:, None] * exponents.clamp(min=_FAINTEST).exp()).clamp(max=MAX_ALPHA)
    alphas = torch.where(alphas >= MIN_ALPHA, alphas, 0.0)
    # Transmittance never rises, so all Gaussians behind the first that would leave too little leave too little too.
    throughs = torch.cat([through, through * (1 - alphas).cumprod(dim=0)])
    weights = torch.where(throughs[1:] > MIN_TRANSMITTANCE, alphas * throughs[:-1], 0.0)
    return weights.T @ channels, throughs[-1:]


def _add_absolute(gradient: Tensor, sums: Tensor, ids: Tensor) -> None:
    sums.index_add_(0, ids, gradient.abs().sum(dim=1))


# ----------------------------------------------------------------------------------------------------------- harmonics


def write_basis(degree: int, x: Any, y: Any, z: Any, out: Any) -> None:
    """Write the real spherical harmonics of a unit vector, up to degree 4, to ``out``; numbers or tensors.

    Within a degree l the order m runs from -l to l (P.-P. Sloan, "Efficient Spherical Harmonic Evaluation", JCGT
    2013). The signs are those of 3DGS: odd orders m carry the Condon-Shortley phase.
    """
    out[0] = 0.5 / sqrt(pi)
    if degree < 1:
        return
    c = sqrt(3 / (4 * pi))
    out[1], out[2], out[3] = -c * y, c * z, -c * x
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    xy, cos2 = x * y, xx - yy
    c1, c0 = sqrt(15 / (4 * pi)), sqrt(5 / (16 * pi))
    out[4], out[5], out[6], out[7] = c1 * xy, -c1 * y * z, c0 * (3 * zz - 1), -c1 * x * z
    out[8] = 0.5 * c1 * cos2
    if degree < 3:
        return
    cos3, sin3 = x * (xx - 3 * yy), y * (3 * xx - yy)
    c3, c2, c1, c0 = sqrt(35 / (32 * pi)), sqrt(105 / (16 * pi)), sqrt(21 / (32 * pi)), sqrt(7 / (16 * pi))
    inner = 5 * zz - 1
    out[9], out[10], out[11] = -c3 * sin3, 2 * c2 * xy * z, -c1 * y * inner
    out[12], out[13], out[14], out[15] = c0 * z * (5 * zz - 3), -c1 * x * inner, c2 * z * cos2, -c3 * cos3
    if degree < 4:
        return
    c4, c3 = sqrt(315 / (256 * pi)), sqrt(315 / (32 * pi))
    c2, c1, c0 = sqrt(45 / (64 * pi)), sqrt(45 / (32 * pi)), sqrt(9 / (256 * pi))
    inner2, inner1 = 7 * zz - 1, z * (7 * zz - 3)
    out[16], out[17], out[18], out[19] = 4 * c4 * xy * cos2, -c3 * z * sin3, 2 * c2 * xy * inner2, -c1 * y * inner1
    out[20], out[21] = c0 * (zz * (35 * zz - 30) + 3), -c1 * x * inner1
    out[22], out[23], out[24] = c2 * cos2 * inner2, -c3 * z * cos3, c4 * (x * cos3 - y * sin3)


def harmonic_basis(degree: int, directions: Tensor) -> Tensor:
    """Values ``[N, (degree + 1) ** 2]`` of the harmonics for unit directions ``[N, 3]``; see :func:`write_basis`."""
    x, y, z = directions.unbind(-1)
    values: list[Any] = [None] * (degree + 1) ** 2
    write_basis(degree, x, y, z, values)
    return torch.stack([torch.full_like(x, values[0]), *values[1:]], dim=-1)
