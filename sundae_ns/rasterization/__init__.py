"""Gaussian splatting of one view: one interface, three backends.

:func:`rasterize`, :func:`rasterize_views`, :func:`spherical_harmonics`, :func:`harmonic_colors` and
:func:`blending_weights` are the whole interface; each takes a :class:`Backend` from :func:`select_backend`. ``gsplat``
runs the CUDA kernels of the gsplat package. ``reference`` is differentiable pure torch with the same thresholds, on any
device, in float32 or float64. ``cpu`` computes the same as the reference in loops compiled by numba, many times as
fast.
"""

from sundae_ns.rasterization.gsplat_backend import GsplatBackend, RecordableGsplat
from sundae_ns.rasterization.gsplat_kernels import Capacity
from sundae_ns.rasterization.interface import (
    BackendName,
    blending_weights,
    fastest_device,
    harmonic_colors,
    numba_problem,
    rasterize,
    rasterize_views,
    select_backend,
    spherical_harmonics,
)
from sundae_ns.rasterization.types import Backend, Rasterization

__all__ = [
    "Backend",
    "BackendName",
    "Capacity",
    "GsplatBackend",
    "Rasterization",
    "RecordableGsplat",
    "blending_weights",
    "fastest_device",
    "harmonic_colors",
    "numba_problem",
    "rasterize",
    "rasterize_views",
    "select_backend",
    "spherical_harmonics",
]
