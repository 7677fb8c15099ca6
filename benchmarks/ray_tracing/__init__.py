"""A small ray tracer, and the still life that it renders for ``sundae demo``, the tests and the benchmarks.

``shapes`` and ``textures`` describe solids, ``still_life`` is the scene, ``cameras`` is the orbit around it, ``tracer``
makes images and ``points`` a sparse point cloud. ``capture`` writes them as a nerfstudio data set.
"""

from ray_tracing.capture import write_still_life

__all__ = ["write_still_life"]
