"""Which primitives stay: signals, scores, exact selection, and the policies that decide when. Floor 2.

:func:`decide` turns a field and a configuration into a mask and changes nothing; :func:`sundae_ns.pruning.cutting.cut` asks
it, and prunes a field in training by what it says: at the steps of a policy from :func:`make_policy`, or of a search.
"""

from sundae_ns.pruning.config import PruningConfig, band_rule, single_prune
from sundae_ns.pruning.coverage import band_shares, inclusion_probabilities, neighbor_order, select_systematic
from sundae_ns.pruning.decision import Decision, decide
from sundae_ns.pruning.detail import pixel_detail
from sundae_ns.pruning.edges import field_graph
from sundae_ns.pruning.footprint import footprint
from sundae_ns.pruning.redistribution import grown, heirs, merged
from sundae_ns.pruning.scores import Response, coherence, response, score
from sundae_ns.pruning.selection import kept_count, select_band, select_random, select_sampled, select_top
from sundae_ns.pruning.signals import attribute_signal, color_signal, position_signal

__all__ = [
    "Decision",
    "PruningConfig",
    "Response",
    "attribute_signal",
    "band_rule",
    "band_shares",
    "coherence",
    "color_signal",
    "decide",
    "field_graph",
    "footprint",
    "grown",
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
