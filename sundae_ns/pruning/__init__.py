"""Pruning: signals, scores, exact selection and merging. Knows no schedule.

:func:`decide` turns a field, a configuration and a count into a mask and changes nothing.
:func:`sundae_ns.pruning.cutting.cut` calls it and applies the decision to a field in training.
"""

from sundae_ns.pruning.config import PruningConfig, band_rule, single_prune
from sundae_ns.pruning.coverage import inclusion_probabilities, neighbor_order, select_systematic
from sundae_ns.pruning.decision import Decision, decide
from sundae_ns.pruning.detail import pixel_detail
from sundae_ns.pruning.edges import field_graph
from sundae_ns.pruning.footprint import footprint
from sundae_ns.pruning.redistribution import heirs, merged
from sundae_ns.pruning.scores import Response, response, score
from sundae_ns.pruning.selection import kept_count, select_band, select_random, select_sampled, select_top
from sundae_ns.pruning.signals import attribute_signal, position_signal

__all__ = [
    "Decision",
    "PruningConfig",
    "Response",
    "attribute_signal",
    "band_rule",
    "decide",
    "field_graph",
    "footprint",
    "heirs",
    "inclusion_probabilities",
    "kept_count",
    "merged",
    "neighbor_order",
    "pixel_detail",
    "position_signal",
    "response",
    "score",
    "select_band",
    "select_random",
    "select_sampled",
    "select_systematic",
    "select_top",
    "single_prune",
]
