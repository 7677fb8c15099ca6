"""Options of pruning, shared by training and by the command line."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import tyro

from sundae_ns.errors import ConfigError
from sundae_ns.graphs.neighbors import MOST_EXTENT

Mode = Literal["one-shot", "continuous", "auto", "off"]
ScoreName = Literal[
    "response-contribution",
    "coherence-contribution",
    "detail-contribution",
    "response",
    "coherence",
    "contribution",
    "opacity",
    "random",
]
SelectionName = Literal["sampled", "systematic", "shared", "band", "top"]
SignalName = Literal["attributes", "colors", "positions"]
EdgesName = Literal["centres", "appearance"]
RedistributionName = Literal["none", "merge", "grow"]
RuleName = Literal["robust", "literal"]
DeviceName = Literal["cpu", "field"]


@dataclass
class PruningConfig:
    """When to prune, how much, and by which score.

    The defaults are what ``sundae`` uses: one draw in each stretch of space, in proportion to the contribution to pixels
    with detail, and what is dropped is merged into what stays. The paper's rule is ``selection="band", score="response",
    signal="positions", edges="centres", redistribution="none"``.
    """

    mode: Mode = "one-shot"
    """Prune once (the paper's main strategy), periodically while densifying (lower peak memory), down to what the scene
    needs (by max-psnr-drop, max-bytes or max-primitives), or never."""
    keep_ratio: float = 0.1
    """Share of the primitives to keep at each prune, in (0, 1]; the kept count is exactly round(keep_ratio * N)."""
    selection: SelectionName = "systematic"
    """How scores become a choice: one draw in each stretch of space (systematic), independent draws (sampled), a systematic
    draw with a share for every band of the response (shared), the highest (top), or both ends as in the paper (band)."""
    score: ScoreName = "detail-contribution"
    """What a primitive is worth: its blending weight over the training views (contribution), or the same with pixels weighted
    by the detail in them that the budget cannot show (detail-contribution); its high-pass response, or its energy in the
    low band that the budget spans (coherence), by themselves or times contribution; opacity; or all alike (random)."""
    signal: SignalName = "attributes"
    """What the response is taken of, for the scores that have one: position, colour, opacity and size together, colour, or
    the paper's positions alone."""
    edges: EdgesName = "appearance"
    """What makes neighbours near in the graph: overlap and likeness of colour beside distance (appearance), or distance alone
    as in the paper (centres)."""
    redistribution: RedistributionName = "merge"
    """What becomes of the dropped: each is merged into the kept primitive that is nearest along the graph (merge), those that
    stay grow into the gaps instead (grow), or nothing as in the paper (none). A merge needs a pass over the training
    views."""
    rounds: int = 1
    """Prunes of the one-shot mode, each by the same factor, down to the keep ratio; training goes on in between."""
    round_every: int = 500
    """Steps from one round to the next."""
    gamma: float = 0.5
    """Share of the kept primitives that the band selection takes from the high end, in [0, 1]; the rest is low end."""
    num_neighbors: int = 16
    """Most neighbours of a primitive in the graph; in a field of fewer primitives, all others."""
    graph_device: DeviceName = "field"
    """Where the graph is built and filtered: on the device of the field, which for CUDA is our own kernel, or on the CPU."""
    bandwidth: RuleName = "robust"
    """How the reach and the width of edges are found; the paper's literal rule gives an empty graph on most fields."""
    tau: float | None = None
    """Squared distance below which primitives are joined, in squared scene units; replaces the bandwidth rule's."""
    sigma: float | None = None
    """Width of the edge weights in scene units; replaces the bandwidth rule's."""
    seed: int = 0
    """Seed of random choices; the same on every device."""
    prune_at: int = 15000
    """Step after which the one-shot prune happens."""
    start: int = 2000
    """First step at which continuous pruning may happen."""
    stop: int = 15000
    """Last step at which continuous pruning may happen, or at which auto may look for a smaller field."""
    every: int = 2000
    """Steps from one continuous prune to the next."""
    max_primitives: int | None = None
    """Continuous: never more than this many at any step, densification included; each prune keeps the smaller of this and the
    keep ratio's count. Auto: keep at most this many."""
    target_primitives: int | None = None
    """Continuous: each prune goes down to exactly this count where there are more, instead of by the keep ratio; the last one
    comes after densification, and where that has left fewer, the field is filled up."""
    max_psnr_drop: float | None = None
    """Auto: keep as few as lose at most this many dB against the warm-up field on held-back training views, after
    fine-tuning. 0.1 if no other budget is given."""
    max_bytes: int | None = None
    """Auto: keep as many as are stored in at most this many bytes, everything needed to show the scene counted."""
    search_every: int = 250
    """Auto: steps from one look at the held-back views to the next."""
    patience: int = 4
    """Auto: looks after which a cut that has not recovered is taken back, unless half of the gain that it promises would do."""
    logits: tyro.conf.Suppress[bool] = False
    """Whether ``features_dc`` holds logits of colours instead of harmonics. Not an option: a model says so of its field."""

    @property
    def tolerated_drop(self) -> float:
        """What auto may lose on held-back views, dB: for the count, or for the harmonics alone if that is given."""
        return 0.1 if self.max_psnr_drop is None else self.max_psnr_drop

    @property
    def uses_contribution(self) -> bool:
        """Whether the blending weights over the training views are needed, by the score or by the merge."""
        return self.score.endswith("contribution") or self.redistribution == "merge"

    @property
    def uses_graph(self) -> bool:
        """Whether the neighbour graph is needed, by the score, the selection or the merge."""
        return self.uses_response or self.uses_coherence or self.redistribution == "merge"

    @property
    def uses_response(self) -> bool:
        """Whether the high-pass response is needed, by the score or for its bands."""
        return self.score.startswith("response") or self.selection == "shared"

    @property
    def uses_coherence(self) -> bool:
        """Whether the score needs the local coherence."""
        return self.score.startswith("coherence")

    @property
    def uses_detail(self) -> bool:
        """Whether the score weighs the pixels of the contribution by the detail of the renderings."""
        return self.score == "detail-contribution"

    def share(self, n: int) -> float:
        """Share of ``n`` primitives that one prune keeps: what the target leaves, else the ratio of a round under the cap."""
        if self.target_primitives is not None:
            return min(1.0, self.target_primitives / n)
        ratio = self.keep_ratio ** (1 / self.rounds)
        return ratio if self.max_primitives is None else min(ratio, self.max_primitives / n)

    @property
    def last_prune(self) -> int:
        """Step of the one-shot mode's last round."""
        return self.prune_at + (self.rounds - 1) * self.round_every

    @property
    def ends_growth_at(self) -> int | None:
        """Step of the prune that follows densification; None where there is none."""
        return self.prune_at if self.mode in ("one-shot", "auto") else None

    @property
    def first_prune(self) -> int | None:
        """Step after which something is pruned for the first time; None where nothing is."""
        return self.start if self.mode == "continuous" else self.ends_growth_at

    @property
    def last_due(self) -> int:
        """Step of the last prune that has to come, as long as nothing grows beyond a target or a cap."""
        if self.mode != "continuous":
            return self.last_prune
        if self.target_primitives is not None or self.max_primitives is not None:
            return self.stop
        return self.start + (self.stop - self.start) // self.every * self.every

    @property
    def settled_at(self) -> int:
        """Step after which the field keeps its primitives."""
        return self.stop if self.mode == "continuous" else self.last_prune

    def validate(self) -> None:
        """Check every option.

        Raises:
            ConfigError: the first option that cannot work, and what it may be.
        """
        for name, choices in (
            ("mode", Mode),
            ("selection", SelectionName),
            ("score", ScoreName),
            ("signal", SignalName),
            ("edges", EdgesName),
            ("redistribution", RedistributionName),
            ("bandwidth", RuleName),
            ("graph_device", DeviceName),
        ):
            value = getattr(self, name)
            if value not in get_args(choices):
                raise ConfigError(f"{name} is {value!r}: use one of {', '.join(get_args(choices))}")
        if not 0 < self.keep_ratio <= 1:
            raise ConfigError(f"keep_ratio is {self.keep_ratio}: use a share in (0, 1], 0.1 to keep a tenth")
        if not 0 <= self.gamma <= 1:
            raise ConfigError(f"gamma is {self.gamma}: use a share in [0, 1]")
        at_least = {"num_neighbors": 1, "every": 1, "prune_at": 0, "start": 0, "rounds": 1, "round_every": 1}
        budgets = {"max_primitives": 1, "target_primitives": 1, "max_bytes": 1, "search_every": 1, "patience": 1}
        for name, least in {**at_least, **budgets}.items():
            value = getattr(self, name)
            if value is not None and value < least:
                raise ConfigError(f"{name} is {value}: use at least {least}")
        if self.mode == "continuous" and self.stop < self.start:
            raise ConfigError(f"start ({self.start}) lies after stop ({self.stop}): swap them")
        if self.rounds > 1 and self.mode in ("continuous", "auto"):
            raise ConfigError(f"rounds is {self.rounds} but mode is {self.mode}: set mode to one-shot, or drop rounds")
        for name in ("tau", "sigma"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ConfigError(f"{name} is {value}: use a positive number, or leave it out for the bandwidth rule")
        # An infinite tau joins all within the list of neighbours; a width has to have a reach that float64 can hold.
        if self.sigma is not None and self.sigma > MOST_EXTENT:
            raise ConfigError(f"sigma is {self.sigma}: use a width of at most {MOST_EXTENT:g} scene units")
        self._validate_budgets()

    def _validate_budgets(self) -> None:
        homes = {
            "max_primitives": ("continuous", "auto"),
            "target_primitives": ("continuous",),
            "max_psnr_drop": ("auto",),
            "max_bytes": ("auto",),
        }
        for name, modes in homes.items():
            if getattr(self, name) is not None and self.mode not in modes:
                raise ConfigError(
                    f"{name} is set but mode is {self.mode}: set mode to {' or '.join(modes)}, or drop {name}"
                )
        if self.mode == "auto":
            given = [
                name for name in ("max_psnr_drop", "max_bytes", "max_primitives") if getattr(self, name) is not None
            ]
            if len(given) > 1:
                raise ConfigError(f"{' and '.join(given)} are both set: give one budget, the others follow from it")
            if not 0 < self.tolerated_drop < float("inf"):
                raise ConfigError(f"max_psnr_drop is {self.max_psnr_drop}: use a positive number of dB, 0.1 for one")
            if self.stop < self.prune_at:
                raise ConfigError(
                    f"stop ({self.stop}) lies before prune_at ({self.prune_at}): auto has no time to search"
                )
        cap, target = self.max_primitives, self.target_primitives
        if cap is not None and target is not None and target > cap:
            raise ConfigError(f"target_primitives ({target}) is more than max_primitives ({cap}): swap them")


def single_prune(config: PruningConfig, keep_ratio: float) -> PruningConfig:
    """The same choice as one prune to a share: without the mode's schedule, and without its budgets."""
    return replace(
        config,
        mode="one-shot",
        keep_ratio=keep_ratio,
        rounds=1,
        max_primitives=None,
        target_primitives=None,
        max_psnr_drop=None,
        max_bytes=None,
    )


def band_rule(config: PruningConfig, keep_ratio: float, gamma: float) -> PruningConfig:
    """The paper's kind of prune to a share: both ends of the response, on a graph of centres, and nothing is merged.

    Of the high end it takes ``gamma``; signal, neighbours and bandwidth are those of ``config``.
    """
    return replace(
        single_prune(config, keep_ratio),
        score="response",
        selection="band",
        gamma=gamma,
        edges="centres",
        redistribution="none",
    )
