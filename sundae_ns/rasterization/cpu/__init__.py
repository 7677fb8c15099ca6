"""The CPU backend: loops compiled by numba. Importing this package imports numba.

- ``parallel``: compilation, its cache on disk, and threads;
- ``lanes``: SIMD values for compiled loops;
- ``projection``: projection of primitives, with hand-written derivatives;
- ``harmonics``: colours from harmonics, with hand-written derivatives;
- ``tiles``: sorting by depth, and the list of each tile;
- ``compositing``: front-to-back blending, and its derivatives back to front;
- ``backend``: the backend made of these stages.
"""

from sundae_ns.rasterization.cpu.backend import CpuBackend

__all__ = ["CpuBackend"]
