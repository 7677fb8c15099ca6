"""The CPU backend: loops compiled by numba. Importing this package imports numba.

- ``parallel``: compilation, its cache on disk, and threads;
- ``lanes``: SIMD values for compiled loops;
- ``tiles``: sorting by depth, and the list of each tile;
- ``compositing``: front-to-back blending, and its derivatives back to front;
- ``backend``: projection and harmonics with their derivatives, and the backend made of these stages.
"""

from sundae_ns.rasterization.cpu.backend import CpuBackend

__all__ = ["CpuBackend"]
