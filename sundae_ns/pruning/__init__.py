"""Pruning: signals, scores, exact selection and merging. Knows no schedule.

:func:`prune_field` takes a field, a :class:`PruneRule` and a count, and returns a new field; :func:`decide` returns the
mask alone. :class:`sundae_ns.pruning.cutting.FieldPruner` applies the same decision to a field in training.
"""

from sundae_ns.pruning.decision import Decision, Pruned, decide, prune_field
from sundae_ns.pruning.edges import field_graph
from sundae_ns.pruning.rule import PruneRule, band_rule
from sundae_ns.pruning.scores import response
from sundae_ns.pruning.selection import check_share, kept_count, select_random

__all__ = [
    "Decision",
    "PruneRule",
    "Pruned",
    "band_rule",
    "check_share",
    "decide",
    "field_graph",
    "kept_count",
    "prune_field",
    "response",
    "select_random",
]
