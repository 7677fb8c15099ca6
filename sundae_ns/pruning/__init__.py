"""Pruning: signals, scores, exact selection and merging. Knows no schedule.

:func:`decide` turns a field, a configuration and a count into a mask and changes nothing.
:func:`sundae_ns.pruning.cutting.cut` calls it and applies the decision to a field in training.
"""

from sundae_ns.pruning.config import PruningConfig, band_rule, single_prune
from sundae_ns.pruning.decision import Decision, decide
from sundae_ns.pruning.edges import field_graph
from sundae_ns.pruning.footprint import footprint
from sundae_ns.pruning.scores import response
from sundae_ns.pruning.selection import kept_count, select_random

__all__ = [
    "Decision",
    "PruningConfig",
    "band_rule",
    "decide",
    "field_graph",
    "footprint",
    "kept_count",
    "response",
    "select_random",
    "single_prune",
]
