"""The rule of a prune: which primitives stay, and what becomes of the others. It knows no count and no schedule."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args, get_origin, get_type_hints

from sundae_ns.errors import ConfigError
from sundae_ns.graphs.neighbors import MOST_EXTENT


@dataclass
class PruneRule:
    """How a prune ranks, selects and merges primitives.

    The defaults are those of ``sundae``: systematic draws in proportion to the contribution to pixels with detail, and
    each dropped primitive merged into a kept one. The paper's rule is ``selection="band", score="response",
    signal="positions", edges="centres", redistribution="none"``.
    """

    selection: Literal["sampled", "systematic", "pairs", "band", "top"] = "systematic"
    """How scores select primitives: one draw in each stretch of space (systematic), independent draws (sampled), one
    for each group of the pairs that differ least (pairs), the highest scores (top), or both ends of the ranking as in
    the paper (band)."""
    score: Literal["response-contribution", "detail-contribution", "response", "contribution", "opacity", "random"] = (
        "detail-contribution"
    )
    """Importance of a primitive: its blending weight over the training views (contribution), the same with pixels
    weighted by the detail that the kept primitives cannot show (detail-contribution), its high-pass response, alone or
    times the contribution, its opacity, or the same for all (random)."""
    signal: Literal["attributes", "positions"] = "attributes"
    """Signal of the response: position, colour, opacity and size (attributes), or positions alone as in the paper."""
    edges: Literal["centres", "appearance"] = "appearance"
    """Weights of the graph: by distance, overlap and colour (appearance), or as in the paper by distance (centres)."""
    redistribution: Literal["none", "merge"] = "merge"
    """Whether each dropped primitive is merged into the kept one that is nearest along the graph, or of its group
    (merge), or discarded as in the paper (none). A merge needs a pass over the training views."""
    gamma: float = 0.5
    """Share of the kept primitives that the band selection takes from the high end, in [0, 1]."""
    num_neighbors: int = 16
    """Most neighbours of a primitive in the graph."""
    graph_device: Literal["cpu", "field"] = "field"
    """Where the graph is built and filtered: on the device of the field, or on the CPU."""
    bandwidth: Literal["robust", "literal"] = "robust"
    """Rule for the reach and the width of edges; the paper's literal rule gives an empty graph on most fields."""
    tau: float | None = None
    """Squared distance below which primitives are neighbours, in squared scene units; replaces the rule's."""
    sigma: float | None = None
    """Width of the edge weights in scene units; replaces the rule's."""
    seed: int = 0
    """Seed of random draws, which are the same on every device."""

    @property
    def uses_contribution(self) -> bool:
        """Whether score or merge need the blending weights over the training views."""
        return self.score.endswith("contribution") or self.redistribution == "merge"

    @property
    def uses_graph(self) -> bool:
        """Whether score, selection or merge need the neighbour graph."""
        return self.uses_response or self.redistribution == "merge" or self.selection == "pairs"

    @property
    def refits(self) -> bool:
        """Whether :func:`sundae_ns.prune` fits what is left to the images of the views; training does so by itself."""
        return self.selection == "pairs" and self.redistribution == "merge"

    @property
    def uses_edge_weights(self) -> bool:
        """Whether score or merge need the weights of the graph's edges; pairs need only its neighbours."""
        return self.uses_response or self.selection != "pairs"

    @property
    def uses_response(self) -> bool:
        """Whether the score needs the high-pass response."""
        return self.score.startswith("response")

    @property
    def uses_detail(self) -> bool:
        """Whether the contribution weights pixels by the detail that the kept primitives cannot show."""
        return self.score == "detail-contribution"

    def validate(self) -> None:
        """Check every option.

        Raises:
            ConfigError: names the first invalid option and its valid values.
        """
        for name, kind in get_type_hints(type(self)).items():
            value, choices = getattr(self, name), get_args(kind) if get_origin(kind) is Literal else ()
            if choices and value not in choices:
                raise ConfigError(f"{name} is {value!r}: use one of {', '.join(choices)}")
        if not 0 <= self.gamma <= 1:
            raise ConfigError(f"gamma is {self.gamma}: use a share in [0, 1]")
        self.check_at_least(num_neighbors=1)
        for name in ("tau", "sigma"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ConfigError(f"{name} is {value}: use a positive number, or leave it out for the bandwidth rule")
        # An infinite tau joins all listed neighbours; the reach of a width must fit into float64.
        if self.sigma is not None and self.sigma > MOST_EXTENT:
            raise ConfigError(f"sigma is {self.sigma}: use a width of at most {MOST_EXTENT:g} scene units")

    def check_at_least(self, **limits: int) -> None:
        """Raise ``ConfigError`` for the first option, by name, that is set and lower than its limit."""
        for name, least in limits.items():
            value = getattr(self, name)
            if value is not None and value < least:
                raise ConfigError(f"{name} is {value}: use at least {least}")


def band_rule(rule: PruneRule, gamma: float) -> PruneRule:
    """The paper's rule: both ends of the response, a share ``gamma`` of the high end, and no merge.

    Signal, number of neighbours and bandwidth are those of ``rule``.
    """
    return replace(rule, score="response", selection="band", gamma=gamma, edges="centres", redistribution="none")
