"""The CPU backend: numba compiles its loops for the machine it runs on; importing this package imports numba.

- ``parallel``: how loops are compiled, cached on disk and shared among threads;
- ``projection``: primitives to the screen and back, with hand-written derivatives;
- ``tiles``: order of depth, and the list of every tile;
- ``compositing``: blending front to back, and its derivatives back to front;
- ``backend``: the three in one view.
"""

from sundae_ns.rasterization.cpu.backend import CpuBackend

__all__ = ["CpuBackend"]
