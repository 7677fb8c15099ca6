"""The old class path of :class:`PruningConfig`, which the ``config.yml`` of earlier runs names."""

from sundae_ns.training.pruning_config import PruningConfig

__all__ = ["PruningConfig"]
