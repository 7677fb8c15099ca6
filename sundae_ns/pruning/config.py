"""Options of pruning, shared by training and by the command line."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args, get_origin, get_type_hints

from sundae_ns.errors import ConfigError
from sundae_ns.graphs.neighbors import MOST_EXTENT


@dataclass
class PruningConfig:
    """When to prune, how much, and by which score.

    The defaults are those of ``sundae``: systematic draws in proportion to the contribution to pixels with detail, and each
    dropped primitive merged into a kept one. The paper's rule is ``selection="band", score="response",
    signal="positions", edges="centres", redistribution="none"``.
    """

    mode: Literal["one-shot", "continuous", "auto", "off"] = "one-shot"
    """Prune once (one-shot, the paper's main strategy), periodically during densification for less peak memory (continuous),
    down to a budget of PSNR, bytes or primitives (auto), or never (off)."""
    keep_ratio: float = 0.1
    """Share of the N primitives that one prune keeps, in (0, 1]: exactly round(keep_ratio * N)."""
    selection: Literal["sampled", "systematic", "band", "top"] = "systematic"
    """How scores select primitives: one draw in each stretch of space (systematic), independent draws (sampled), the highest
    scores (top), or both ends of the ranking as in the paper (band)."""
    score: Literal["response-contribution", "detail-contribution", "response", "contribution", "opacity", "random"] = (
        "detail-contribution"
    )
    """Importance of a primitive: its blending weight over the training views (contribution), the same with pixels weighted by
    the detail that the kept primitives cannot show (detail-contribution), its high-pass response, alone or times the
    contribution, its opacity, or the same for all (random)."""
    signal: Literal["attributes", "positions"] = "attributes"
    """Signal of the response: position, colour, opacity and size (attributes), or positions alone as in the paper."""
    edges: Literal["centres", "appearance"] = "appearance"
    """Weights of the graph: by distance, overlap and colour (appearance), or by distance alone as in the paper (centres)."""
    redistribution: Literal["none", "merge"] = "merge"
    """Whether each dropped primitive is merged into the kept one that is nearest along the graph (merge), or discarded as in
    the paper (none). A merge needs a pass over the training views."""
    gamma: float = 0.5
    """Share of the kept primitives that the band selection takes from the high end, in [0, 1]; the others are the low end."""
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
    prune_at: int = 15000
    """Step after which the one-shot prune happens."""
    start: int = 2000
    """First step of continuous pruning."""
    stop: int = 15000
    """Last step of continuous pruning, or of the search of auto."""
    every: int = 2000
    """Steps from one continuous prune to the next."""
    max_primitives: int | None = None
    """Continuous: most primitives at any step, densification included; a prune keeps at most this many. Auto: most primitives
    of the final field."""
    target_primitives: int | None = None
    """Continuous: each prune keeps exactly this many, instead of a share by the keep ratio. The final field has exactly this
    many; if densification ends with fewer, primitives are added."""
    max_psnr_drop: float | None = None
    """Auto: keep the fewest primitives that, after fine-tuning, lose at most this PSNR in dB against the field before pruning,
    on held-out training views. 0.1 if no other budget is set."""
    max_bytes: int | None = None
    """Auto: keep the most primitives that fit into this many bytes of parameters, head included."""
    search_every: int = 250
    """Auto: steps from one measurement on the held-out views to the next."""
    patience: int = 4
    """Auto: measurements after which a cut that has not recovered is undone, unless half of its predicted gain suffices."""

    @property
    def tolerated_drop(self) -> float:
        """PSNR that auto may lose on held-out views, dB; 0.1 by default."""
        return 0.1 if self.max_psnr_drop is None else self.max_psnr_drop

    @property
    def uses_contribution(self) -> bool:
        """Whether score or merge need the blending weights over the training views."""
        return self.score.endswith("contribution") or self.redistribution == "merge"

    @property
    def uses_graph(self) -> bool:
        """Whether score or merge need the neighbour graph."""
        return self.uses_response or self.redistribution == "merge"

    @property
    def uses_response(self) -> bool:
        """Whether the score needs the high-pass response."""
        return self.score.startswith("response")

    @property
    def uses_detail(self) -> bool:
        """Whether the score weights the pixels of the contribution by the detail of the rendered images."""
        return self.score == "detail-contribution"

    @property
    def ends_growth_at(self) -> int | None:
        """Step of the prune after densification; None if the mode has none."""
        return self.prune_at if self.mode in ("one-shot", "auto") else None

    @property
    def first_prune(self) -> int | None:
        """Step of the first prune; None if the mode is off."""
        return self.start if self.mode == "continuous" else self.ends_growth_at

    @property
    def last_due(self) -> int:
        """Step of the last scheduled prune; later ones happen only if the field exceeds a target or a cap."""
        if self.mode != "continuous":
            return self.prune_at
        if self.target_primitives is not None or self.max_primitives is not None:
            return self.stop
        return self.start + (self.stop - self.start) // self.every * self.every

    @property
    def settled_at(self) -> int:
        """Step after which the number of primitives does not change."""
        return self.stop if self.mode == "continuous" else self.prune_at

    def validate(self) -> None:
        """Check every option.

        Raises:
            ConfigError: names the first invalid option and its valid values.
        """
        for name, kind in get_type_hints(type(self)).items():
            value, choices = getattr(self, name), get_args(kind) if get_origin(kind) is Literal else ()
            if choices and value not in choices:
                raise ConfigError(f"{name} is {value!r}: use one of {', '.join(choices)}")
        if not 0 < self.keep_ratio <= 1:
            raise ConfigError(f"keep_ratio is {self.keep_ratio}: use a share in (0, 1], 0.1 to keep a tenth")
        if not 0 <= self.gamma <= 1:
            raise ConfigError(f"gamma is {self.gamma}: use a share in [0, 1]")
        at_least = {"num_neighbors": 1, "every": 1, "prune_at": 0, "start": 0}
        budgets = {"max_primitives": 1, "target_primitives": 1, "max_bytes": 1, "search_every": 1, "patience": 1}
        for name, least in {**at_least, **budgets}.items():
            value = getattr(self, name)
            if value is not None and value < least:
                raise ConfigError(f"{name} is {value}: use at least {least}")
        if self.mode == "continuous" and self.stop < self.start:
            raise ConfigError(f"start ({self.start}) lies after stop ({self.stop}): swap them")
        for name in ("tau", "sigma"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ConfigError(f"{name} is {value}: use a positive number, or leave it out for the bandwidth rule")
        # An infinite tau joins all listed neighbours; the reach of a width must fit into float64.
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
    """Options of one prune to ``keep_ratio`` by the rule of ``config``, without its schedule and budgets."""
    return replace(
        config,
        mode="one-shot",
        keep_ratio=keep_ratio,
        max_primitives=None,
        target_primitives=None,
        max_psnr_drop=None,
        max_bytes=None,
    )


def band_rule(config: PruningConfig, keep_ratio: float, gamma: float) -> PruningConfig:
    """Options of one prune to ``keep_ratio`` by the paper's rule: both ends of the response, no merge.

    Signal, number of neighbours and bandwidth are those of ``config``; ``gamma`` is the share of the high end.
    """
    return replace(
        single_prune(config, keep_ratio),
        score="response",
        selection="band",
        gamma=gamma,
        edges="centres",
        redistribution="none",
    )
