"""Options of pruning in training: the schedule, with the rule of its prunes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sundae_ns.errors import ConfigError
from sundae_ns.pruning.rule import PruneRule
from sundae_ns.pruning.selection import check_share


@dataclass
class PruningConfig(PruneRule):
    """When to prune and how many primitives to keep, beside the rule that says which.

    One class, because ``config.yml`` and the command line have these options side by side. Code that prunes takes the
    :class:`sundae_ns.pruning.PruneRule` alone.
    """

    mode: Literal["one-shot", "continuous", "auto", "off"] = "one-shot"
    """Prune once (one-shot, the paper's main strategy), periodically during densification for less peak memory
    (continuous), down to a budget of PSNR, bytes or primitives (auto), or never (off)."""
    keep_ratio: float = 0.1
    """Share of the N primitives that one prune keeps, in (0, 1]: exactly round(keep_ratio * N)."""
    prune_at: int = 15000
    """Step after which the one-shot prune happens."""
    start: int = 2000
    """First step of continuous pruning."""
    stop: int = 15000
    """Last step of continuous pruning, or of the search of auto."""
    every: int = 2000
    """Steps from one continuous prune to the next."""
    max_primitives: int | None = None
    """Continuous: most primitives at any step, densification included; a prune keeps at most this many. Auto: most
    primitives of the final field."""
    target_primitives: int | None = None
    """Continuous: each prune keeps exactly this many, instead of a share by the keep ratio. The final field has exactly
    this many; if densification ends with fewer, primitives are added."""
    max_psnr_drop: float | None = None
    """Auto: keep the fewest primitives that, after fine-tuning, lose at most this PSNR in dB against the field before
    pruning, on held-out training views. 0.1 if no other budget is set."""
    max_bytes: int | None = None
    """Auto: keep the most primitives that fit into this many bytes of parameters, head included."""
    search_every: int = 250
    """Auto: steps from one measurement on the held-out views to the next."""
    patience: int = 4
    """Auto: measurements after which a cut that has not recovered is taken back, unless half of its predicted gain
    is enough."""

    @property
    def tolerated_drop(self) -> float:
        """PSNR that auto may lose on held-out views, dB; 0.1 by default."""
        return 0.1 if self.max_psnr_drop is None else self.max_psnr_drop

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
        """Check every option of the schedule and of its rule.

        Raises:
            ConfigError: names the first invalid option and its valid values.
        """
        super().validate()
        check_share(self.keep_ratio)
        self.check_at_least(every=1, prune_at=0, start=0, search_every=1, patience=1)
        self.check_at_least(max_primitives=1, target_primitives=1, max_bytes=1)
        if self.mode == "continuous" and self.stop < self.start:
            raise ConfigError(f"start ({self.start}) lies after stop ({self.stop}): swap them")
        homes = {
            "max_psnr_drop": ("auto",),
            "max_bytes": ("auto",),
            "max_primitives": ("continuous", "auto"),
            "target_primitives": ("continuous",),
        }
        given = [name for name in homes if getattr(self, name) is not None]
        for name in given:
            if self.mode not in homes[name]:
                raise ConfigError(
                    f"{name} is set but mode is {self.mode}: set mode to {' or '.join(homes[name])}, or drop {name}"
                )
        if self.mode == "auto":
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
