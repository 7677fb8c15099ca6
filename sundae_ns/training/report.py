"""What a prune did, for logs and result tables."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PruneReport:
    """Plain numbers of one prune."""

    step: int
    """Training step after which it happened."""
    before: int
    """Primitives before it, NaN and infinite ones included."""
    after: int
    """Primitives after it."""
    dropped_nonfinite: int
    """Primitives that went because a parameter of theirs was NaN or infinite."""
    peak: int
    """Most primitives at any step so far."""
    seconds: float
    """Wall-clock time of decision and surgery, the device waited for."""
    tau: float | None
    """Threshold of the graph on squared distances, squared scene units; None if no graph was needed."""
    sigma: float | None
    """Width of the graph's weights, scene units; None if no graph was needed."""
    isolated: int | None
    """Primitives without a neighbour within the threshold; None if no graph was needed."""

    def summary(self) -> str:
        """One line for the log."""
        parts = [f"step {self.step}: kept {self.after:,} of {self.before:,} primitives in {self.seconds:.1f} s"]
        parts.append(f"peak {self.peak:,}")
        if self.dropped_nonfinite:
            parts.append(f"{self.dropped_nonfinite:,} were NaN or infinite")
        if self.sigma is not None and self.tau is not None:
            parts.append(f"sigma {self.sigma:.3g}, tau {self.tau:.3g}, {self.isolated:,} isolated")
        return "; ".join(parts)
