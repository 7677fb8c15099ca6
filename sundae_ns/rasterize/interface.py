"""The public functions: they check the arguments, and a backend computes. And the choice of a backend."""

from __future__ import annotations

from functools import cache
from typing import Literal

import torch
from torch import Tensor

from sundae_ns.core.errors import BackendError, ConfigError, DataError
from sundae_ns.core.gaussians import MAX_SH_DEGREE
from sundae_ns.rasterize.gsplat_backend import GsplatBackend, RecordableGsplat
from sundae_ns.rasterize.reference import ReferenceBackend
from sundae_ns.rasterize.types import Backend, Inputs, Rasterization, check_memory, constant

BackendName = Literal["auto", "gsplat", "cpu", "reference"]


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
    """Splat N Gaussians into one pinhole view (EWA splatting, front-to-back blending; Kerbl et al. 2023).

    Differentiable with respect to the Gaussians, and to ``viewmat`` except under gsplat; not to ``K``.

    Args:
        means: Centres in world units. ``[N, 3]``
        quats: Rotations as wxyz quaternions of any length; all-zero ones are the identity. ``[N, 4]``
        scales: Standard deviations in world units, post-activation. ``[N, 3]``
        opacities: Opacities in [0, 1], post-activation. ``[N]``
        colors: Vectors to blend, such as colours and features. ``[N, C]`` with C >= 1
        viewmat: World-to-camera transform, OpenCV axes (x right, y down, z forward). ``[4, 4]``
        K: Intrinsics in pixels. ``[3, 3]``
        width: Image width in pixels.
        height: Image height in pixels.
        near_plane: Gaussians with a smaller camera z are culled. World units.
        far_plane: Gaussians with a larger camera z are culled. World units.
        antialiased: Scale opacities by the ratio of screen areas without and with blur (Mip-Splatting).
        absgrad: Let the backward pass set ``info["means2d"].absgrad`` (AbsGS): absolute per-pixel gradients, summed.
        render_depth: Also blend camera z.
        backend: From :func:`select_backend`.

    Raises:
        DataError: A tensor has the wrong shape, dtype or device, or the image is empty.
        MemoryExhaustedError: On a CPU, the image or its lists need more memory than there is, or without gradients the
            view has more Gaussians than any real scene.
    """
    inputs = Inputs(
        *(means, quats, scales, opacities, colors, viewmat, K, width, height),
        *(near_plane, far_plane, antialiased, absgrad, render_depth),
    )
    _check(inputs)
    if means.device.type == "cpu":
        size = (colors.shape[1] + 2) * width * height * means.element_size()
        check_memory(size, f"images of {width:,} x {height:,} pixels")
    return backend.rasterize(inputs)


def rasterize_cameras(
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
    """Splat N Gaussians into V views of one size; for many small images, whose launches would take most of the time.

    Arguments are those of :func:`rasterize`, but for colours, transforms and intrinsics of each view.

    Returns:
        Blended colours ``[V, H, W, C]``, those of :func:`rasterize` up to rounding.

    Raises:
        DataError: As :func:`rasterize`, or there is no view.
    """
    count = len(viewmats)
    if not count:
        raise DataError("there is no view to rasterize; give at least one")
    _check_shapes((viewmats, "viewmats", (count, 4, 4)), (Ks, "Ks", (count, 3, 3)))
    if colors.dim() != 3 or colors.shape[0] != count:
        raise DataError(f"colors has shape {list(colors.shape)}; pass [{count}, {len(means)}, C]")
    cameras = [
        Inputs(means, quats, scales, opacities, *camera, width, height, near_plane, far_plane, antialiased)
        for camera in zip(colors, viewmats, Ks, strict=True)
    ]
    _check(cameras[0])
    if isinstance(backend, GsplatBackend) and len(means):
        return backend.rasterize_cameras(cameras[0], viewmats, Ks, colors)
    return torch.stack([backend.rasterize(camera).colors for camera in cameras])


def spherical_harmonics(degree: int, directions: Tensor, coeffs: Tensor, *, backend: Backend) -> Tensor:
    """Evaluate real spherical harmonics up to ``degree``: the raw sum, without the 0.5 that colours add.

    Args:
        degree: SH degree, 0 to 4; only the first ``(degree + 1) ** 2`` coefficients are read.
        directions: From the camera to the Gaussian, of any length; zero vectors are taken as +z, without gradient.
            ``[N, 3]``
        coeffs: Coefficients in the order and with the signs of 3DGS. ``[N, K, 3]``
        backend: From :func:`select_backend`.

    Returns:
        ``[N, 3]``

    Raises:
        DataError: The degree is out of range or a shape is wrong.
    """
    if not 0 <= degree <= MAX_SH_DEGREE:
        raise DataError(f"spherical harmonics of degree {degree} are unknown; use 0 to {MAX_SH_DEGREE}")
    n = directions.shape[0]
    _check_shapes((directions, "directions", (n, 3)))
    needed = (degree + 1) ** 2
    if coeffs.dim() != 3 or coeffs.shape[0] != n or coeffs.shape[1] < needed or coeffs.shape[2] != 3:
        raise DataError(f"coeffs has shape {list(coeffs.shape)}; degree {degree} needs [{n}, {needed} or more, 3]")
    _check_alike("directions", directions, coeffs=coeffs)
    # Replace them here: gsplat's kernel returns NaN where the camera is at a Gaussian's centre.
    is_zero = (directions == 0).all(dim=-1, keepdim=True)
    ahead = constant((0.0, 0.0, 1.0), directions.dtype, directions.device)
    return backend.spherical_harmonics(degree, torch.where(is_zero, ahead, directions), coeffs)


def harmonic_colors(
    degree: int, means: Tensor, center: Tensor, features_dc: Tensor, features_rest: Tensor, *, backend: Backend
) -> Tensor:
    """Colours of Gaussians as seen from a point: their harmonics plus 0.5, at least 0.

    Args:
        degree: SH degree, 0 to 4.
        means: Centres in world units. ``[N, 3]``
        center: Camera centre ``[3]``, or one for each Gaussian ``[N, 3]``.
        features_dc: First coefficients. ``[N, 3]``
        features_rest: The others, at least those of the degree. ``[N, K - 1, 3]``
        backend: From :func:`select_backend`.

    Returns:
        ``[N, 3]``

    Raises:
        DataError: The degree is out of range or a shape is wrong.
    """
    if isinstance(backend, RecordableGsplat) and len(means):
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
    """Contribution of each Gaussian to one view: its alpha times transmittance, summed over the pixels.

    Blending is linear in the colours. So this is exactly the gradient of the summed image with respect to a one-channel
    colour, and no backend needs code for it. Arguments are those of :func:`rasterize`, and:

    Args:
        pixels: Weight of each pixel; None for 1. ``[H, W]``

    Returns:
        ``[N]``, in pixels, detached; 0 for Gaussians that are invisible.

    Raises:
        DataError: As :func:`rasterize`, or ``pixels`` has another size than the image.
    """
    if pixels is not None:
        _check_shapes((pixels, "pixels", (height, width)))
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
    shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "viewmat": (4, 4), "K": (3, 3)}
    _check_shapes(*((getattr(inputs, name), name, shape) for name, shape in shapes.items()))
    if colors.dim() != 2 or colors.shape[0] != n or colors.shape[1] < 1:
        raise DataError(f"colors has shape {list(colors.shape)}; pass [{n}, C] with at least one channel")
    _check_alike("means", means, colors=colors, **{name: getattr(inputs, name) for name in shapes})


def _check_shapes(*values: tuple[Tensor, str, tuple[int, ...]]) -> None:
    for value, name, shape in values:
        if tuple(value.shape) != shape:
            raise DataError(f"{name} has shape {list(value.shape)}; pass {list(shape)}")


def _check_alike(name: str, model: Tensor, **others: Tensor) -> None:
    for other, value in others.items():
        if value.dtype != model.dtype or value.device != model.device:
            raise DataError(
                f"{other} is {value.dtype} on {value.device} but {name} is {model.dtype} on {model.device}; convert one"
            )


def select_backend(name: BackendName, device: torch.device | str) -> Backend:
    """Choose the rasteriser for tensors on ``device``.

    ``auto`` chooses gsplat on a CUDA device where its kernels run, cpu on a CPU where numba works, and else the
    reference. Each check runs once per process; it builds gsplat's kernels if none are prebuilt. Only a CUDA device
    imports gsplat, and only a CPU numba.

    Raises:
        BackendError: ``gsplat`` or ``cpu`` was requested and cannot run on ``device``.
        ConfigError: The name is unknown.
    """
    device = torch.device(device)
    if name not in ("auto", "gsplat", "cpu", "reference"):
        raise ConfigError(f"unknown rasterizer {name!r}; use auto, gsplat, cpu or reference")
    if name in ("auto", "gsplat"):
        problem = _gsplat_problem(device)
        if problem is None:
            return GsplatBackend()
        if name == "gsplat":
            raise BackendError(f"gsplat cannot rasterize: {problem}; or use the backend 'reference'")
    if name in ("auto", "cpu"):
        on_cpu = device.type == "cpu"
        problem = numba_problem() if on_cpu else f"the tensors are on the device '{device}'; move them to 'cpu'"
        if problem is None:
            return _cpu_backend()
        if name == "cpu":
            raise BackendError(f"the cpu backend cannot rasterize: {problem}; or use the backend 'reference'")
    return ReferenceBackend()


def fastest_device() -> torch.device:
    """A CUDA device where gsplat's kernels run, else the CPU: where commands put a scene."""
    cuda = torch.device("cuda")
    return cuda if _gsplat_problem(cuda) is None else torch.device("cpu")


def _gsplat_problem(device: torch.device) -> str | None:
    """Cause and remedy if gsplat cannot run on a device, else None."""
    if not torch.cuda.is_available():
        return "CUDA is not available; use a machine with an NVIDIA GPU and a CUDA build of torch"
    if device.type != "cuda":
        return f"the tensors are on the device '{device}'; move them to 'cuda'"
    return _kernel_problem()


@cache
def _kernel_problem() -> str | None:
    """Run gsplat's smallest kernel; the cause and remedy if it fails, else None."""
    try:
        ones = torch.ones(1, 1, 3, device="cuda")
        GsplatBackend().spherical_harmonics(0, ones[0], ones).sum().item()
    except ImportError as error:
        return f"gsplat does not import ({_first_line(error)}); install gsplat"
    except Exception as error:  # a failed build or a missing kernel image raises errors of many kinds
        return f"its kernels do not run ({_first_line(error)}); install a gsplat wheel for this torch, or nvcc"
    return None


@cache
def numba_problem() -> str | None:
    """Render one pixel with the compiled loops; the cause and remedy if that fails, else None.

    This takes half a second, or some seconds if the loops were never compiled before.
    """
    try:
        ones = torch.ones(1, 4)
        camera = (torch.eye(4), torch.eye(3), 1, 1)
        rasterize(ones[:, :3], ones, ones[:, :3], ones[:, 0], ones[:, :1], *camera, backend=_cpu_backend())
    except ImportError as error:
        return f"numba does not import ({_first_line(error)}); pip install numba"
    except Exception as error:  # versions, processors and settings that numba refuses raise errors of many kinds
        remedy = "pip install --force-reinstall numba, and unset NUMBA_DISABLE_JIT"
        return f"numba does not compile ({_first_line(error)}); {remedy}"
    return None


def _cpu_backend() -> Backend:
    from sundae_ns.rasterize.cpu.backend import CpuBackend

    return CpuBackend()


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
