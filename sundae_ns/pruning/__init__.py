"""Pruning: scores, exact selection, merging, and the decision made of them. Knows no schedule.

:func:`prune_field` takes a field, a :class:`PruneRule` and a count, and returns a new field; :func:`decide` returns the
mask alone; :class:`FieldPruner` applies the same decision to a field in training.
"""

from sundae_ns.pruning.decision import Decision, FieldPruner, Pruned, decide, prune_field
from sundae_ns.pruning.merge import field_graph
from sundae_ns.pruning.rule import PruneRule, band_rule, check_share, kept_count
from sundae_ns.pruning.scores import response

__all__ = [
    "Decision",
    "FieldPruner",
    "PruneRule",
    "Pruned",
    "band_rule",
    "check_share",
    "decide",
    "field_graph",
    "kept_count",
    "prune_field",
    "response",
]
