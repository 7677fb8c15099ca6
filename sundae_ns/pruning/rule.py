"""The rule of a prune: which Gaussians stay, and what becomes of the others. It knows no count and no schedule."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from numbers import Integral, Real
from typing import Literal, get_args, get_origin, get_type_hints

from torch import Tensor

from sundae_ns.core.errors import ConfigError

ScoreName = Literal["detail-contribution", "response"]


@dataclass
class PruneRule:
    """How a prune ranks, selects and merges Gaussians.

    The defaults are those of ``sundae prune``, which loses less without training. ``ns-train sundae`` draws
    systematically, in proportion to the contribution to pixels with detail. :func:`band_rule` is the paper's.
    """

    selection: Literal["systematic", "pairs", "band"] = "pairs"
    """How scores select Gaussians: one draw in each stretch of space (systematic), one for each group of the pairs
    that differ least (pairs), or both ends of the ranking as in the paper (band)."""
    score: ScoreName | Callable[[Mapping[str, Tensor]], Tensor] = "detail-contribution"
    """Importance of a Gaussian: its blending weight over the training views, with pixels weighted by the detail that
    the kept Gaussians cannot show (detail-contribution), or its high-pass response (response). Any other score is a
    function of the parameters of N finite Gaussians that returns numbers ``[N]``, not negative."""
    signal: Literal["attributes", "positions"] = "attributes"
    """Signal of the response: position, colour, opacity and size (attributes), or positions alone as in the paper."""
    edges: Literal["centres", "appearance"] = "appearance"
    """Weights of the graph: by distance, overlap and colour (appearance), or as in the paper by distance (centres)."""
    redistribution: Literal["none", "merge"] = "merge"
    """Whether each dropped Gaussian is merged into the kept one that is nearest along the graph, or of its group
    (merge), or discarded as in the paper (none). A merge needs a pass over the training views."""
    gamma: float = 0.5  # Share of the kept Gaussians that the band selection takes from the high end, in [0, 1]
    num_neighbors: int = 16  # Most neighbours of a Gaussian in the graph; pairs take the nearer half
    seed: int = 0  # Seed of random draws, which are the same on every device

    def __post_init__(self) -> None:
        if type(self) is PruneRule:  # those of commands are checked later, with all else
            self.validate()

    @property
    def uses_contribution(self) -> bool:
        """Whether score or merge need the blending weights over the training views."""
        return self.uses_detail or self.redistribution == "merge"

    @property
    def uses_graph(self) -> bool:
        """Whether score, selection or merge need the neighbour graph."""
        return self.score == "response" or self.redistribution == "merge" or self.selection == "pairs"

    @property
    def uses_edge_weights(self) -> bool:
        """Whether score or merge need the weights of the graph's edges; pairs need only its neighbours."""
        return self.score == "response" or self.selection != "pairs"

    @property
    def uses_detail(self) -> bool:
        """Whether the contribution weights pixels by the detail that the kept Gaussians cannot show."""
        return self.score == "detail-contribution"

    @property
    def refits(self) -> bool:
        """Whether :func:`sundae_ns.prune` fits the kept Gaussians to images of the views, as training does anyway."""
        return self.selection == "pairs" and self.redistribution == "merge"

    def validate(self) -> None:
        """Raise a ConfigError that names the first invalid option and its valid values."""
        for name, hint in get_type_hints(type(self)).items():
            value = getattr(self, name)
            kinds = hint, *get_args(hint)
            choices = [choice for kind in kinds if get_origin(kind) is Literal for choice in get_args(kind)]
            kind = {int: Integral, float: Real}.get(hint, object)
            if not (value in choices or callable(value) if choices else isinstance(value, kind)):
                wanted = f"one of {', '.join(choices)}" if choices else "a number"
                raise ConfigError(f"{name} is {value!r}: use {wanted}")
        if not 0 <= self.gamma <= 1:
            raise ConfigError(f"gamma is {self.gamma}: use a share in [0, 1]")
        self.check_at_least(num_neighbors=1)

    def check_at_least(self, **limits: int) -> None:
        """Raise ``ConfigError`` for the first option, by name, that is set and lower than its limit."""
        for name, least in limits.items():
            if (value := getattr(self, name)) is not None and value < least:
                raise ConfigError(f"{name} is {value}: use at least {least}")


def band_rule(rule: PruneRule, gamma: float) -> PruneRule:
    """The paper's rule: both ends of the response, a share ``gamma`` of the high end, and no merge.

    Signal and number of neighbours are those of ``rule``; the paper's signal is positions.
    """
    return replace(rule, score="response", selection="band", gamma=gamma, edges="centres", redistribution="none")


def kept_count(share: float, n: int) -> int:
    """``round(share * n)`` of ``n`` Gaussians, at least 1; ``ConfigError`` for a share that is not in (0, 1]."""
    if not 0 < share <= 1:
        raise ConfigError(f"keep_ratio is {share}: use a share in (0, 1], 0.1 to keep a tenth")
    return max(1, round(share * n))
