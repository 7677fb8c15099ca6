"""The public functions, which check the arguments and call a backend, and the choice of a backend."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache, partial
from typing import Any, Literal, TypeVar, cast

import torch
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import BackendError, ConfigError, DataError, MemoryExhaustedError, one_line
from sundae_ns.core.gaussians import MAX_SH_DEGREE
from sundae_ns.core.values import usual_defaults
from sundae_ns.rasterize import gsplat_kernels
from sundae_ns.rasterize.gsplat_backend import GsplatBackend, RecordableGsplat, check_kernels_take
from sundae_ns.rasterize.reference import ReferenceBackend
from sundae_ns.rasterize.types import Backend, Inputs, Rasterization, check_memory, constant

BackendName = Literal["auto", "gsplat", "cpu", "reference"]
T = TypeVar("T")


@usual_defaults()
def rasterize(inputs: Inputs, *, backend: Backend) -> Rasterization:
    """Splat N Gaussians into one pinhole camera (EWA splatting, front-to-back blending; Kerbl et al. 2023).

    Differentiable with respect to the Gaussians and to ``camera.viewmat``; under gsplat not to ``camera.K``.
    ``DataError`` for a tensor of a wrong shape, dtype or device, and for an empty image; ``MemoryExhaustedError`` if,
    on a CPU, the image or its lists need more memory than there is, or without gradients it has more Gaussians than any
    real one.
    """
    _check(inputs)
    if inputs.means.device.type == "cpu":
        width, height = inputs.camera.width, inputs.camera.height
        # Beside the blended channels: accumulation, state of the pixels, depth, and a base image with its parts.
        size = (inputs.colors.shape[1] + 15) * width * height * inputs.means.element_size()
        check_memory(size, f"images of {width:,} x {height:,} pixels")
    return (backend if len(inputs.means) else ReferenceBackend()).rasterize(inputs)  # CUDA has no grids of no blocks


def rasterize_cameras(inputs: Inputs, viewmats: Tensor, Ks: Tensor, *, backend: Backend) -> Tensor:
    """Splat N Gaussians into V cameras of one size; for many small images, whose launches would take most of the time.

    ``inputs`` and errors are as for :func:`rasterize`, but with colours for each camera ``[V, N, C]``. Of its camera
    only the size is read; ``viewmats`` are ``[V, 4, 4]``, ``Ks`` ``[V, 3, 3]``. It has neither depth nor ``absgrad``.
    Returns blended colours ``[V, H, W, C]``, those of :func:`rasterize` up to rounding.
    """
    count, colors = len(viewmats), inputs.colors
    if not count:
        raise DataError("there is no view to rasterize; give at least one")
    _check_shapes((viewmats, "viewmats", (count, 4, 4)), (Ks, "Ks", (count, 3, 3)))
    if colors.dim() != 3 or colors.shape[0] != count:
        raise DataError(f"colors has shape {list(colors.shape)}; pass [{count}, {len(inputs.means)}, C]")
    views = [inputs.camera._replace(viewmat=viewmat, K=K) for viewmat, K in zip(viewmats, Ks, strict=True)]
    singles = [replace(inputs, colors=color, camera=camera) for color, camera in zip(colors, views, strict=True)]
    if isinstance(backend, GsplatBackend) and len(inputs.means):
        _check(singles[0])
        return backend.rasterize_cameras(inputs, viewmats, Ks)
    over_views = two_at_once if inputs.means.is_cpu and not torch.is_grad_enabled() else map
    return torch.stack([image.colors for image in over_views(partial(rasterize, backend=backend), singles)])


def two_at_once(function: Callable[[Any], T], views: Iterable[Any]) -> Iterator[T]:
    """As ``map`` without gradients, for views on a CPU: two at a time, each on half of the threads; of one, one."""
    threads = torch.get_num_threads()
    torch.set_num_threads(threads)  # two threads cannot make the pool of a forked process
    try:
        with ThreadPoolExecutor(min(2, threads), "views", torch.set_num_threads, (max(1, threads // 2),)) as pool:
            yield from pool.map(torch.no_grad()(function), views)  # each thread has a mode of its own
    finally:
        torch.set_num_threads(threads)


def harmonic_colors(
    degree: int, means: Tensor, center: Tensor, features_dc: Tensor, features_rest: Tensor, *, backend: Backend
) -> Tensor:
    """Colours of Gaussians as seen from a point: their harmonics plus 0.5, at least 0 ``[N, 3]``.

    ``center`` is that of the camera ``[3]``, or one for each Gaussian ``[N, 3]``; one that is there is seen along +z,
    without a gradient of its place. Coefficients ``features_dc`` ``[N, 3]`` and ``features_rest`` ``[N, K - 1, 3]``, of
    this degree or a higher one, have the order and the signs of 3DGS. ``DataError`` for a degree outside of 0 to 4, and
    for a tensor of a wrong shape, dtype or device.
    """
    if not 0 <= degree <= MAX_SH_DEGREE:
        raise DataError(f"spherical harmonics of degree {degree} are unknown; use 0 to {MAX_SH_DEGREE}")
    n, needed, rest = len(means), (degree + 1) ** 2 - 1, features_rest.shape
    _check_shapes((means, "means", (n, 3)), (features_dc, "features_dc", (n, 3)))
    if len(rest) != 3 or rest[0] != n or rest[1] < needed or rest[2] != 3:
        raise DataError(f"features_rest has shape {list(rest)}; degree {degree} needs [{n}, {needed} or more, 3]")
    _check_alike(means, center=center, features_dc=features_dc, features_rest=features_rest)
    backend = backend if n else ReferenceBackend()
    if isinstance(backend, RecordableGsplat):
        check_kernels_take(means)
        return cast("Tensor", gsplat_kernels.harmonic_colors(degree, means, center, features_dc, features_rest))
    directions = means - center
    # Replace zeros here: gsplat's kernel returns NaN for them.
    ahead = constant((0.0, 0.0, 1.0), means.dtype, means.device)
    directions = torch.where((directions == 0).all(dim=-1, keepdim=True), ahead, directions)
    return (backend.spherical_harmonics(degree, directions, features_dc, features_rest) + 0.5).clamp_min(0)


def blending_weights(inputs: Inputs, pixels: Tensor | None = None, *, backend: Backend) -> Tensor:
    """Contribution of each Gaussian to one image ``[N]``: its alpha times transmittance, summed over pixels, detached.

    Blending is linear in the colours. So this is exactly the gradient of the summed image with respect to a one-channel
    colour, and no backend needs code for it. ``pixels`` ``[H, W]`` are weights; None stands for 1. All else is as for
    :func:`rasterize`; colours are ignored.
    """
    camera = inputs.camera._replace(viewmat=inputs.camera.viewmat.detach(), K=inputs.camera.K.detach())
    if pixels is not None:
        _check_shapes((pixels, "pixels", (camera.height, camera.width)))
    fixed = {name: getattr(inputs, name).detach() for name in ("means", "quats", "scales", "opacities")}
    with torch.enable_grad():
        ones = torch.ones_like(fixed["means"][:, :1], requires_grad=True)
        image = rasterize(replace(inputs, **fixed, colors=ones, camera=camera), backend=backend).colors
        return torch.autograd.grad(image.sum() if pixels is None else (image[..., 0] * pixels).sum(), ones)[0][:, 0]


def _check(inputs: Inputs) -> None:
    camera, colors, n = inputs.camera, inputs.colors, len(inputs.means)
    if min(camera.width, camera.height) < 1:
        raise DataError(f"an image of {camera.width}x{camera.height} pixels is empty; both sides must be at least 1")
    shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "viewmat": (4, 4), "K": (3, 3)}
    tensors = {name: getattr(inputs if hasattr(inputs, name) else camera, name) for name in shapes}
    _check_shapes(*((value, name, shapes[name]) for name, value in tensors.items()))
    if colors.dim() != 2 or colors.shape[0] != n or colors.shape[1] < 1:
        raise DataError(f"colors has shape {list(colors.shape)}; pass [{n}, C] with at least one channel")
    _check_alike(inputs.means, colors=colors, **tensors)


def _check_shapes(*values: tuple[Tensor, str, tuple[int, ...]]) -> None:
    for value, name, shape in values:
        if tuple(value.shape) != shape:
            raise DataError(f"{name} has shape {list(value.shape)}; pass {list(shape)}")


def _check_alike(means: Tensor, /, **others: Tensor) -> None:
    if means.dtype not in (torch.float32, torch.float64):
        raise DataError(f"means is {means.dtype}; give float32 or float64")
    for name, value in others.items():
        if value.dtype != means.dtype or value.device != means.device:
            first, second = (f"{each.dtype} on {each.device}" for each in (value, means))
            raise DataError(f"{name} is {first} but means is {second}; convert one")


def select_backend(name: BackendName, device: torch.device | str) -> Backend:
    """Choose the rasteriser for tensors on ``device``.

    ``auto`` chooses gsplat on a CUDA device where its kernels run, cpu on a CPU where numba works, and else the
    reference. Each check runs once per process; it builds gsplat's kernels if none are prebuilt. Only a CUDA device
    imports gsplat, and only a CPU numba. ``BackendError`` for one that cannot run there, ``ConfigError`` for another
    name, ``MemoryExhaustedError`` if the memory is full.
    """
    device = torch.device(device)
    if name not in ("auto", "gsplat", "cpu", "reference"):
        raise ConfigError(f"unknown rasterizer {name!r:.80}; use auto, gsplat, cpu or reference")
    for backend, make, problem_on in (("gsplat", GsplatBackend, _gsplat_problem), ("cpu", _cpu_backend, _cpu_problem)):
        if name in ("auto", backend):
            if (problem := problem_on(device)) is None:
                return make()
            if name == backend:
                raise BackendError(f"{backend} cannot rasterize: {problem}; or use the backend 'reference'")
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


def _cpu_problem(device: torch.device) -> str | None:
    return numba_problem() if device.type == "cpu" else f"the tensors are on the device '{device}'; move them to 'cpu'"


@cache
def _kernel_problem() -> str | None:
    """Run gsplat's smallest kernel; the cause and remedy if it fails, else None."""
    try:
        ones = torch.ones(1, 1, 3, dtype=torch.float32, device="cuda")
        GsplatBackend().spherical_harmonics(0, ones[0], ones[0], ones[:, 1:]).sum().item()
    except ImportError as error:
        return f"gsplat does not import ({one_line(error)}); install gsplat"
    except Exception as error:  # a failed build or a missing kernel image raises errors of many kinds
        if "out of memory" in str(error):  # an error is not cached, and other programs may end
            raise MemoryExhaustedError(f"the GPU's memory is full ({one_line(error)}); end other programs") from error
        return f"its kernels do not run ({one_line(error)}); install a gsplat wheel for this torch, or nvcc"
    return None


@cache
def numba_problem() -> str | None:
    """Render one pixel with the compiled loops, which may compile them; cause and remedy if that fails, else None."""
    try:
        ones = torch.ones(1, 4, dtype=torch.float32, device="cpu")
        camera = Camera(ones[0].diag(), ones[0, :3].diag(), 1, 1, 1.0)
        rasterize(Inputs(ones[:, :3], ones, ones[:, :3], ones[:, 0], ones[:, :1], camera), backend=_cpu_backend())
    except ImportError as error:
        return f"numba does not import ({one_line(error)}); pip install numba"
    except MemoryError as error:
        raise MemoryExhaustedError(f"the memory is full ({one_line(error)}); end other programs") from error
    except Exception as error:  # versions, processors and settings that numba refuses raise errors of many kinds
        return f"numba does not compile ({one_line(error)}); unset NUMBA_DISABLE_JIT, and install numba again"
    return None


def _cpu_backend() -> Backend:
    from sundae_ns.rasterize.cpu.backend import CpuBackend  # imports numba

    return CpuBackend()
