"""Options of pruning in training: the schedule, with the rule of its prunes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sundae_ns.errors import ConfigError
from sundae_ns.pruning.rule import PruneRule, ScoreName, check_share

USUAL_SHARE = 0.1
"""Share that a prune keeps unless it is told otherwise; also where trials cannot decide."""


@dataclass
class PruningConfig(PruneRule):
    """When to prune and how many primitives to keep, beside the rule that says which.

    One class, because ``config.yml`` and the command line have these options side by side. Code that prunes takes the
    :class:`sundae_ns.pruning.PruneRule` alone.
    """

    score: ScoreName = "detail-contribution"
    """Importance of a primitive: its blending weight over the training views, with pixels weighted by the detail that
    the kept primitives cannot show (detail-contribution), or its high-pass response (response)."""
    mode: Literal["one-shot", "continuous", "off"] = "one-shot"
    """Prune once (one-shot, the paper's main strategy), periodically during densification for less peak memory
    (continuous), or never (off)."""
    keep_ratio: float | None = USUAL_SHARE
    """Share of the N primitives that one prune keeps, in (0, 1]: exactly round(keep_ratio * N). One-shot: None lets
    trials on held-out training views decide the number."""
    prune_at: int = 12000
    """Step after which the one-shot prune happens."""
    start: int = 2000
    """First step of continuous pruning."""
    stop: int = 15000
    """Last step of continuous pruning."""
    every: int = 2000
    """Steps from one continuous prune to the next."""
    max_primitives: int | None = None
    """Continuous: most primitives at any step, densification included; a prune keeps at most this many. One-shot: most
    primitives that the prune keeps."""
    target_primitives: int | None = None
    """Each prune keeps exactly this many, instead of a share or of what trials choose. Continuous: the final field has
    exactly this many; if densification ends with fewer, primitives are added."""
    max_drop: float | None = None
    """One-shot, where trials decide: PSNR in dB that a smaller field may lose against the best one, and SSIM in
    proportion. None for 0.1 dB and 0.003."""
    max_bytes: int | None = None
    """One-shot, where trials decide: most bytes of the packed scene, by an estimate."""

    @property
    def decides(self) -> bool:
        """Whether trials decide how many primitives the one-shot prune keeps."""
        return self.mode == "one-shot" and self.keep_ratio is None and self.target_primitives is None

    @property
    def ends_growth_at(self) -> int | None:
        """Step of the prune after densification; None if the mode has none."""
        return self.prune_at if self.mode == "one-shot" else None

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
        if self.keep_ratio is not None:
            check_share(self.keep_ratio)
        self.check_at_least(every=1, prune_at=0, start=0, max_primitives=1, target_primitives=1, max_bytes=1)
        if self.mode == "continuous" and self.stop < self.start:
            raise ConfigError(f"start ({self.start}) lies after stop ({self.stop}): swap them")
        if self.mode == "continuous" and self.keep_ratio is None and self.target_primitives is None:
            raise ConfigError(
                "keep_ratio is None and mode is continuous, without trials: give 0.5, or target_primitives"
            )
        if self.mode == "off" and (self.max_primitives is not None or self.target_primitives is not None):
            raise ConfigError("mode is off, which prunes nothing: set mode to one-shot, or drop the number")
        for name in ("max_drop", "max_bytes"):
            if getattr(self, name) is not None and not self.decides:
                raise ConfigError(
                    f"{name} is set, and trials do not decide the number of primitives: set keep_ratio to None and "
                    "mode to one-shot, as sundae does"
                )
        if self.max_drop is not None and not 0 < self.max_drop < float("inf"):
            raise ConfigError(f"max_drop is {self.max_drop}: use a positive number of dB, 0.1 for one")
        cap, target = self.max_primitives, self.target_primitives
        if cap is not None and target is not None and target > cap:
            raise ConfigError(f"target_primitives ({target}) is more than max_primitives ({cap}): swap them")
