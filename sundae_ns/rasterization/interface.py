"""The public functions: they check the arguments, a backend computes."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.gaussians.parameters import MAX_SH_DEGREE
from sundae_ns.rasterization.constants import constant
from sundae_ns.rasterization.limits import check_memory
from sundae_ns.rasterization.types import Backend, BatchBackend, ColorBackend, Inputs, Rasterization


def rasterize(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [N, C]
    viewmat: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    antialiased: bool = False,
    absgrad: bool = False,
    render_depth: bool = False,
    backend: Backend,
) -> Rasterization:
    """Splat N Gaussian primitives into one pinhole view (EWA splatting, front-to-back blending; Kerbl et al. 2023).

    Differentiable with respect to the primitives, and to ``viewmat`` except under gsplat; not to ``K``.

    Args:
        means: Centres in world units. ``[N, 3]``
        quats: Rotations as wxyz quaternions of any length; all-zero ones are the identity. ``[N, 4]``
        scales: Standard deviations in world units, post-activation. ``[N, 3]``
        opacities: Opacities in [0, 1], post-activation. ``[N]``
        colors: Per-primitive vectors to blend, such as colours and features. ``[N, C]`` with C >= 1
        viewmat: World-to-camera transform, OpenCV axes (x right, y down, z forward). ``[4, 4]``
        K: Intrinsics in pixels. ``[3, 3]``
        width: Image width in pixels.
        height: Image height in pixels.
        near_plane: Primitives with a smaller camera z are culled. World units.
        far_plane: Primitives with a larger camera z are culled. World units.
        antialiased: Scale opacities by the ratio of screen areas without and with blur (Mip-Splatting).
        absgrad: Let the backward pass set ``info["means2d"].absgrad`` (AbsGS): absolute per-pixel gradients, summed.
        render_depth: Also blend camera z.
        backend: From :func:`sundae_ns.rasterization.select_backend`.

    Raises:
        DataError: A tensor has the wrong shape, dtype or device, or the image is empty.
        MemoryExhaustedError: On a CPU, the image or its lists need more memory than there is, or without gradients the
            view has more primitives than any real scene.
    """
    inputs = Inputs(
        *(means, quats, scales, opacities, colors, viewmat, K, width, height, near_plane, far_plane),
        antialiased=antialiased,
        absgrad=absgrad,
        render_depth=render_depth,
    )
    _check(inputs)
    if means.device.type == "cpu":
        size = (colors.shape[1] + 2) * width * height * means.element_size()
        check_memory(size, f"images of {width:,} x {height:,} pixels")
    return backend.rasterize(inputs)


def rasterize_views(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [V, N, C]
    viewmats: Tensor,  # [V, 4, 4]
    Ks: Tensor,  # [V, 3, 3]
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    antialiased: bool = False,
    backend: Backend,
) -> Tensor:
    """Splat N primitives into V views of one size; for many small images, whose launches would take most of the time.

    Arguments are those of :func:`rasterize`, but for colours, transforms and intrinsics of each view.

    Returns:
        Blended colours ``[V, H, W, C]``, those of :func:`rasterize` up to rounding.

    Raises:
        DataError: As :func:`rasterize`, or there is no view.
    """
    count = len(viewmats)
    if not count:
        raise DataError("there is no view to rasterize; give at least one")
    _check_shape("viewmats", viewmats, (count, 4, 4))
    _check_shape("Ks", Ks, (count, 3, 3))
    if colors.dim() != 3 or colors.shape[0] != count:
        raise DataError(f"colors has shape {list(colors.shape)}; pass [{count}, {len(means)}, C]")
    shared = (means, quats, scales, opacities)
    if not isinstance(backend, BatchBackend) or not len(means):
        options: dict[str, Any] = {"near_plane": near_plane, "far_plane": far_plane, "antialiased": antialiased}
        views = zip(colors, viewmats, Ks, strict=True)
        images = (rasterize(*shared, *view, width, height, **options, backend=backend) for view in views)
        return torch.stack([image.colors for image in images])
    inputs = Inputs(
        *(*shared, colors[0], viewmats[0], Ks[0], width, height, near_plane, far_plane),
        antialiased=antialiased,
        absgrad=False,
        render_depth=False,
    )
    _check(inputs)
    return backend.rasterize_views(inputs, viewmats, Ks, colors)


def spherical_harmonics(degree: int, directions: Tensor, coeffs: Tensor, *, backend: Backend) -> Tensor:
    """Evaluate real spherical harmonics up to ``degree``: the raw sum, without the 0.5 that colours add.

    Args:
        degree: SH degree, 0 to 4; only the first ``(degree + 1) ** 2`` coefficients are read.
        directions: From the camera to the primitive, of any length; zero vectors are taken as +z, without gradient.
            ``[N, 3]``
        coeffs: Coefficients in the order and with the signs of 3DGS. ``[N, K, 3]``
        backend: From :func:`sundae_ns.rasterization.select_backend`.

    Returns:
        ``[N, 3]``

    Raises:
        DataError: The degree is out of range or a shape is wrong.
    """
    if not 0 <= degree <= MAX_SH_DEGREE:
        raise DataError(f"spherical harmonics of degree {degree} are unknown; use 0 to {MAX_SH_DEGREE}")
    n = directions.shape[0]
    _check_shape("directions", directions, (n, 3))
    needed = (degree + 1) ** 2
    if coeffs.dim() != 3 or coeffs.shape[0] != n or coeffs.shape[1] < needed or coeffs.shape[2] != 3:
        raise DataError(f"coeffs has shape {list(coeffs.shape)}; degree {degree} needs [{n}, {needed} or more, 3]")
    _check_alike("directions", directions, coeffs=coeffs)
    # Replace them here: gsplat's kernel returns NaN where the camera is at a primitive's centre.
    is_zero = (directions == 0).all(dim=-1, keepdim=True)
    ahead = constant((0.0, 0.0, 1.0), directions.dtype, directions.device)
    directions = torch.where(is_zero, ahead, directions)
    return backend.spherical_harmonics(degree, directions, coeffs)


def harmonic_colors(
    degree: int, means: Tensor, center: Tensor, features_dc: Tensor, features_rest: Tensor, *, backend: Backend
) -> Tensor:
    """Colours of primitives as seen from a place: their harmonics plus 0.5, at least 0.

    Args:
        degree: SH degree, 0 to 4.
        means: Centres in world units. ``[N, 3]``
        center: Camera centre ``[3]``, or one for each primitive ``[N, 3]``.
        features_dc: First coefficients. ``[N, 3]``
        features_rest: The others, at least those of the degree. ``[N, K - 1, 3]``
        backend: From :func:`sundae_ns.rasterization.select_backend`.

    Returns:
        ``[N, 3]``

    Raises:
        DataError: The degree is out of range or a shape is wrong.
    """
    if isinstance(backend, ColorBackend) and len(means) > 0:
        return backend.harmonic_colors(degree, means, center, features_dc, features_rest)
    coeffs = torch.cat([features_dc[:, None], features_rest], dim=1)
    return (spherical_harmonics(degree, means - center, coeffs, backend=backend) + 0.5).clamp_min(0)


def blending_weights(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    viewmat: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    antialiased: bool = False,
    pixels: Tensor | None = None,
    backend: Backend,
) -> Tensor:
    """Contribution of each primitive to one view: its alpha times transmittance, summed over the pixels.

    Blending is linear in the colours. So this is exactly the gradient of the summed image with respect to a one-channel
    colour, and no backend needs code for it. Arguments are those of :func:`rasterize`, and:

    Args:
        pixels: Weight of each pixel; None for 1. ``[H, W]``

    Returns:
        ``[N]``, in pixels, detached; 0 for primitives that are invisible.

    Raises:
        DataError: As :func:`rasterize`, or ``pixels`` has another size than the image.
    """
    if pixels is not None:
        _check_shape("pixels", pixels, (height, width))
    means, quats, scales, opacities, viewmat, K = (
        value.detach() for value in (means, quats, scales, opacities, viewmat, K)
    )
    with torch.enable_grad():
        ones = torch.ones_like(means[:, :1], requires_grad=True)
        image = rasterize(
            *(means, quats, scales, opacities, ones, viewmat, K, width, height),
            near_plane=near_plane,
            far_plane=far_plane,
            antialiased=antialiased,
            backend=backend,
        ).colors
        (weights,) = torch.autograd.grad(image.sum() if pixels is None else (image[..., 0] * pixels).sum(), ones)
    return weights[:, 0]


def _check(inputs: Inputs) -> None:
    means, colors, n = inputs.means, inputs.colors, len(inputs.means)
    if inputs.width < 1 or inputs.height < 1:
        size = f"{inputs.width}x{inputs.height}"
        raise DataError(f"an image of {size} pixels is empty; width and height must be at least 1")
    _check_shape("means", means, (n, 3))
    _check_shape("quats", inputs.quats, (n, 4))
    _check_shape("scales", inputs.scales, (n, 3))
    _check_shape("opacities", inputs.opacities, (n,))
    _check_shape("viewmat", inputs.viewmat, (4, 4))
    _check_shape("K", inputs.K, (3, 3))
    if colors.dim() != 2 or colors.shape[0] != n or colors.shape[1] < 1:
        raise DataError(f"colors has shape {list(colors.shape)}; pass [{n}, C] with at least one channel")
    others = ("quats", "scales", "opacities", "colors", "viewmat", "K")
    _check_alike("means", means, **{name: getattr(inputs, name) for name in others})


def _check_shape(name: str, value: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(value.shape) != shape:
        raise DataError(f"{name} has shape {list(value.shape)}; pass {list(shape)}")


def _check_alike(name: str, model: Tensor, **others: Tensor) -> None:
    for other, value in others.items():
        if value.dtype != model.dtype or value.device != model.device:
            raise DataError(
                f"{other} is {value.dtype} on {value.device} but {name} is {model.dtype} on {model.device}; convert one"
            )
