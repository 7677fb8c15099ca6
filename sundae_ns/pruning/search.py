"""How few primitives a scene needs: cut, let training recover, look at held-back views, go on or step back.

Right after a cut a field is far worse than after some training, and how much worse says little about where it ends. So a
cut is judged by what training makes of it: it is accepted as soon as the held-back views reach the target again, and
taken back if they have not after ``patience`` looks, or cannot any more at the rate of the last look (recovery slows
down, so that this rate is the best to be hoped for). Steps behind an accepted cut are the fine-tuning itself; only those
behind a cut that is taken back are lost.

This module holds the decisions, as plain numbers; :mod:`sundae_ns.budget` acts on them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

from sundae_ns.errors import CheckpointError

FIRST_FACTOR = 0.5
"""Share of the primitives that the first cut keeps; each cut that is taken back is followed by a gentler one."""

_KINDS: dict[str, tuple[type, ...]] = {"int": (int,), "float": (int, float), "bool": (bool,)}

Phase = Literal["before", "field", "head", "done"]
Verdict = Literal["accepted", "waiting", "rejected"]


@dataclass
class Point:
    """One look at the held-back views."""

    step: int
    """Step of training."""
    phase: str
    """``field``: base colours alone; ``head``: with the head; ``final``: at the end of the run."""
    primitives: int
    bytes: int
    """What would be stored, head included where it takes part."""
    psnr: float
    """Mean PSNR over the held-back views, dB."""
    verdict: str
    since_cut: int
    """Steps of training since the cut."""


@dataclass
class Search:
    """State of the search; plain numbers and strings, so that a checkpoint can carry it."""

    phase: Phase = "before"
    reference: float = math.nan
    """PSNR of the warm-up field on the held-back views, dB."""
    target: float = math.nan
    """PSNR that has to be kept, dB."""
    began: int = 0
    """Step of the schedule at which the search began."""
    factor: float = FIRST_FACTOR
    looks: int = 0
    """Looks since the last cut."""
    last_psnr: float = math.nan
    rejected: int = 0
    """Cuts taken back in this phase."""
    accepted: int = 0
    """Primitives of the field that training would go back to."""
    cut_at: int = 0
    """Step of the schedule of the last cut."""
    head: bool = False
    """Whether the head takes part."""
    head_dropped: bool = False
    """Whether it was decided that this scene needs no head."""
    degree: int = -1
    """Degree of the spherical harmonics that was chosen; -1 before."""
    before: int = 0
    """Primitives of the warm-up field."""
    steps_lost: int = 0
    """Steps of training behind cuts that were taken back."""
    seconds: float = 0.0
    """Time that looking, scoring and cutting took, training not counted."""
    views: int = 0
    """Held-back views."""
    zeroed: int = 0
    """Primitives whose bands above 0 were found to carry nothing, and were set to 0."""
    degrees: dict[str, float] = field(default_factory=dict)
    """PSNR of the warm-up field by degree of its harmonics, dB."""
    curve: list[Point] = field(default_factory=list)

    @property
    def searching(self) -> bool:
        """Whether cuts are being tried."""
        return self.phase in ("field", "head")

    def begin(self, phase: Literal["field", "head"], accepted: int) -> None:
        """Start a phase from a field that meets the target."""
        self.phase, self.accepted = phase, accepted
        self.factor, self.rejected, self.looks, self.last_psnr = FIRST_FACTOR, 0, 0, math.nan

    def next_count(self, least: int) -> int | None:
        """Primitives after the next cut; None if there is nothing to cut any more."""
        count = max(int(self.accepted * self.factor), least)
        return count if count < self.accepted else None

    def cut(self, step: int) -> None:
        """A cut was made after this step of the schedule."""
        self.cut_at, self.looks, self.last_psnr = step, 0, math.nan

    def judge(self, psnr: float, step: int, patience: int, *, last: bool, steady: bool = True) -> Verdict:
        """Judge the last cut by a look at the held-back views.

        Args:
            psnr: mean over the views, dB.
            step: of the schedule.
            patience: looks that a cut may take to recover.
            last: no further look is left.
            steady: recovery only slows down, so that a cut that cannot make it any more may be taken back early; not so
                while a network joins.
        """
        self.looks += 1
        left = 0 if last else patience - self.looks
        # The first look has nothing to compare with: what a cut costs is not what training gains.
        gain = psnr - self.last_psnr if self.looks > 1 and steady else math.inf
        self.last_psnr = psnr
        if psnr >= self.target:
            return "accepted"
        if left > 0 and psnr + gain * left >= self.target:
            return "waiting"
        self.rejected += 1
        self.factor = math.sqrt(self.factor)
        self.steps_lost += step - self.cut_at
        return "rejected"

    def state(self) -> dict[str, Any]:
        """Plain numbers for a checkpoint."""
        return asdict(self)

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Search:
        """Counterpart of :meth:`state`.

        Raises:
            CheckpointError: it is not what :meth:`state` gives.
        """
        try:
            if set(state) != {f.name for f in fields(cls)}:
                raise ValueError("other entries")
            search = cls(**{**state, "curve": [Point(**point) for point in state["curve"]]})
            if search.phase not in ("before", "field", "head", "done") or not -1 <= search.degree <= 4:
                raise ValueError("unknown phase or degree")
            for f in fields(cls):
                kinds = _KINDS.get(str(f.type))
                if kinds is not None and not isinstance(getattr(search, f.name), kinds):
                    raise ValueError(f"{f.name} is no {f.type}")
        except (TypeError, ValueError, KeyError, AttributeError) as error:
            raise CheckpointError(
                f"the checkpoint does not say where its search for a budget stood ({error}); give another"
            ) from error
        return search


def curve_text(points: Sequence[Point], target: float, width: int = 40) -> str:
    """The curve as lines of text, one a look, the fewest primitives last; bars are dB above the worst look."""
    if not points:
        return ""
    low = min([point.psnr for point in points] + [target])
    span = max([point.psnr for point in points] + [target]) - low or 1.0
    mark = round((target - low) / span * (width - 1))
    lines = []
    for point in sorted(points, key=lambda point: (-point.primitives, point.step)):
        bar = list("#" * round((point.psnr - low) / span * (width - 1)) + " " * width)[:width]
        bar[mark] = "|"
        lines.append(
            f"{point.primitives:>10,}  {''.join(bar)} {point.psnr:7.3f} dB  {point.psnr - target:+.3f} to the target  "
            f"step {point.step}, {point.since_cut} after the cut, {point.phase}, {point.verdict}"
        )
    return "\n".join(lines)
