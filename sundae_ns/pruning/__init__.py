"""Which primitives stay: signals, scores, exact selection, and the policies that decide when. Floor 2.

:func:`decide` turns a field and a configuration into a mask and changes nothing; a policy from :func:`make_policy`
calls it at its steps and applies the mask with :func:`sundae_ns.gaussians.surgery.keep`.
"""

from sundae_ns.pruning.config import PruningConfig
from sundae_ns.pruning.decision import Decision, decide
from sundae_ns.pruning.footprint import footprint
from sundae_ns.pruning.policy import ContinuousPruning, NoPruning, OneShotPruning, PruningPolicy, make_policy
from sundae_ns.pruning.report import PruneReport
from sundae_ns.pruning.scores import Response, response, score
from sundae_ns.pruning.selection import kept_count, select_band, select_random, select_sampled, select_top
from sundae_ns.pruning.signals import attribute_signal, position_signal

__all__ = [
    "ContinuousPruning",
    "Decision",
    "NoPruning",
    "OneShotPruning",
    "PruneReport",
    "PruningConfig",
    "PruningPolicy",
    "Response",
    "attribute_signal",
    "decide",
    "footprint",
    "kept_count",
    "make_policy",
    "position_signal",
    "response",
    "score",
    "select_band",
    "select_random",
    "select_sampled",
    "select_top",
]
