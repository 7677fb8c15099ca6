"""Decisions of a budget search: cut, let training recover, evaluate held-out views, accept or reject.

Right after a cut the PSNR says little about where training ends. So a cut is judged after recovery: it is accepted as
soon as the held-out views reach the target again. It may take all steps that are left, as long as it is predicted to
recover. Recovery is close to a line over the logarithm of the steps since the cut; half of the predicted gain is
counted. A cut that is not predicted to recover, or has not when time is up, is rejected, and the field before it is
restored. Steps after an accepted cut are the fine-tuning itself; only those after a rejected cut are lost.

A field with too many primitives may overfit the training views and fall below the target while it is trained on. If it
stays below and gains no more, its own PSNR replaces the target.

The depth of a cut follows from the cut before: its cost per halving after recovery, against the present margin. If the
margin is too small, training goes on until it has grown; once it grows no more, the smallest cut is tried.

This module decides on plain numbers; :mod:`sundae_ns.training.budget.extension` acts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from sundae_ns.compensation.head import SIZES
from sundae_ns.errors import CheckpointError

DEEPEST, SHALLOWEST = 1.0, 0.15
"""Halvings of the deepest cut (removes a half) and of the smallest (removes a tenth)."""

TRUST = 0.5
"""Share of a predicted gain that is counted after ``patience`` evaluations; before, all of it."""

NO_IMAGE = 0.0
"""PSNR that stands for images that are not finite, dB; no image with values in [0, 1] has less."""

_KINDS: dict[str, tuple[type, ...]] = {"int": (int,), "float": (int, float), "bool": (bool,)}

SearchPhase = Literal["before", "degrees", "field", "head", "done"]
Verdict = Literal["accepted", "waiting", "rejected", "no cut"]


@dataclass
class Point:
    """One evaluation on the held-out views."""

    step: int
    """Training step."""
    phase: str
    """``field``: the head is disabled; ``head``: it is enabled; ``final``: at the end of the run."""
    primitives: int
    bytes: int
    """Stored bytes, with the head if it is enabled."""
    psnr: float
    """Mean PSNR over the held-out views, dB."""
    verdict: str
    since_cut: int
    """Training steps since the cut."""


@dataclass
class SearchProgress:
    """State of a search: plain numbers and strings for a checkpoint."""

    phase: SearchPhase = "before"
    reference: float = math.nan
    """PSNR of the warm-up field on the held-out views, dB."""
    target: float = math.nan
    """PSNR to keep, dB."""
    began: int = 0
    """Schedule step at which the search began."""
    lowered: float = math.nan
    """PSNR that replaces the target while the field itself cannot reach it, dB; NaN otherwise."""
    best: float = math.nan
    """Highest PSNR of the field since it was last cut or restored, dB."""
    stuck: int = 0
    """Evaluations since then without a gain."""
    trying: bool = False
    """Whether a cut awaits its verdict."""
    looks: int = 0
    """Evaluations since the last cut or verdict."""
    trail: list[list[float]] = field(default_factory=list)
    """Evaluations since the last cut: training steps since then, and PSNR in dB."""
    margin: float = math.nan
    """Margin above the target before the last cut, dB."""
    slope: float = 0.0
    """Cost of a halving after recovery, measured or predicted at the last verdict, dB."""
    rejected: int = 0
    """Cuts rejected in this phase."""
    failed: int = 0
    """Primitives after the last rejected cut of this phase; 0 if there is none, or a later cut went as far."""
    cuts: int = 0
    """Cuts accepted in this phase."""
    accepted: int = 0
    """Primitives of the field that a rejected cut restores."""
    tried: int = 0
    """Primitives after the last cut."""
    cut_at: int = 0
    """Schedule step of the last cut."""
    head: bool = False
    """Whether the head is enabled."""
    head_at: int = 0
    """Schedule step at which it was enabled."""
    lost_at_join: int = 0
    """``steps_lost`` at that step."""
    head_size: str = ""
    """Its chosen size; empty before the choice."""
    num_features: int = -1
    """Chosen number of features; -1 before the choice."""
    head_dropped: bool = False
    """Whether the search has decided against a head."""
    degree: int = -1
    """SH degree of the present field; -1 before the search."""
    before: int = 0
    """Primitives of the warm-up field."""
    steps_lost: int = 0
    """Training steps after rejected cuts."""
    seconds: float = 0.0
    """Time of evaluating, scoring and cutting, without training."""
    views: int = 0
    """Number of held-out views."""
    dropped_nonfinite: int = 0
    """Primitives removed because a parameter was NaN or infinite."""
    zeroed: int = 0
    """Primitives with view-independent colours."""
    degrees: dict[str, float] = field(default_factory=dict)
    """PSNR by SH degree, dB, each after the same training of the warm-up field."""
    curve: list[Point] = field(default_factory=list)

    def begin(self, phase: Literal["field", "head"], accepted: int) -> None:
        """Start to cut a field that meets the target; the cost of a halving is kept from an earlier phase."""
        self.phase, self.accepted, self.trying = phase, accepted, False
        self.rejected, self.failed, self.cuts, self.looks = 0, 0, 0, 0
        self.lowered, self.best, self.stuck = math.nan, math.nan, 0

    @property
    def tolerated(self) -> float:
        """Tolerated drop, dB."""
        return self.reference - self.target

    @property
    def aim(self) -> float:
        """PSNR that a cut must keep, dB."""
        return self.target if math.isnan(self.lowered) else self.lowered

    @property
    def before_cut(self) -> float:
        """PSNR of the field before the last cut, dB."""
        return self.aim + self.margin

    def next_degree(self, top: int, tolerated: float) -> int | None:
        """The SH degree to try next by bisection from ``top``; None once the lowest sufficient degree is known."""
        if str(top) not in self.degrees:
            return top
        best, worst = self.lowest_degree(top, tolerated), -1
        for name, value in self.degrees.items():
            if value < self._at_top(top) - tolerated:
                worst = max(worst, int(name))
        return None if best - worst <= 1 else (best + worst) // 2

    def lowest_degree(self, top: int, tolerated: float) -> int:
        """The lowest of the tried SH degrees within the tolerated drop."""
        enough = self._at_top(top) - tolerated
        return min((int(name) for name, value in self.degrees.items() if value >= enough), default=top)

    def _at_top(self, top: int) -> float:
        value = self.degrees[str(top)]
        return value if value > NO_IMAGE else self.reference

    def next_count(self, psnr: float, least: int, patience: int) -> int | None:
        """Number of primitives after the next cut; None if the margin is too small, or nothing is left to cut.

        Args:
            psnr: of the field before the cut, dB.
            least: lowest number of primitives.
            patience: evaluations without a gain after which the smallest cut is tried.
        """
        margin = psnr - self.aim
        if margin < 0:
            return None
        halvings = DEEPEST if margin >= self.slope * DEEPEST else margin / self.slope
        if self.stuck >= patience or not math.isnan(self.lowered):
            halvings = max(halvings, SHALLOWEST)  # waiting would change nothing
        if self.failed:
            # Half way to the rejected cut; below that, smallest steps, because training may have gained.
            halvings = min(halvings, max(0.5 * math.log2(self.accepted / self.failed), SHALLOWEST))
        count = max(int(self.accepted * 0.5**halvings), least)
        return count if halvings >= SHALLOWEST and count < self.accepted else None

    def cut(self, psnr: float, count: int, step: int) -> None:
        """Note a cut to ``count`` primitives after this schedule step."""
        self.margin, self.tried, self.cut_at, self.trying, self.looks = psnr - self.aim, count, step, True, 0
        self.trail = []

    def predicted(self, left: int, trust: float) -> float:
        """PSNR of the present cut after ``left`` more steps, dB.

        The least-squares line through the evaluations over the logarithm of the steps since the cut; with a single
        evaluation its own value.

        Args:
            left: training steps to come.
            trust: share of a gain that is counted; a loss is counted whole.
        """
        ages, values = [math.log2(age) for age, _ in self.trail], [psnr for _, psnr in self.trail]
        if len(values) == 1:
            return values[0]
        age, psnr = sum(ages) / len(ages), sum(values) / len(values)
        rise = sum((a - age) * (v - psnr) for a, v in zip(ages, values)) / sum((a - age) ** 2 for a in ages)
        gain = rise * (math.log2(self.trail[-1][0] + left) - ages[-1])
        return psnr + rise * (ages[-1] - age) + gain * (trust if gain > 0 else 1.0)

    def judge(self, psnr: float, step: int, left: int, patience: int) -> Verdict:
        """Judge the last cut, if it awaits a verdict, by an evaluation on the held-out views.

        Args:
            psnr: mean over the views, dB.
            step: schedule step.
            left: training steps in which the cut must recover.
            patience: evaluations before doubts count against a cut.
        """
        self.looks += 1
        if psnr >= self.target:
            self.lowered = math.nan
        if not self.trying:
            self._wait(psnr, patience)
            return "no cut"
        self.trail.append([step - self.cut_at, psnr])
        margin, seen = psnr - self.aim, psnr > NO_IMAGE
        if margin < 0 and left > 0 and seen and self._may_recover(left, patience):
            return "waiting"
        self.trying, self.looks, self.best, self.stuck = False, 0, math.nan, 0
        recovered = margin if margin >= 0 else self.predicted(max(left, 0), TRUST) - self.aim
        if seen:
            # Training gains meanwhile; one lucky cut does not make the next one cheap.
            self.slope = max((self.margin - recovered) / math.log2(self.accepted / self.tried), self.slope / 2)
        if margin >= 0:
            self.accepted, self.cuts = self.tried, self.cuts + 1
            if self.accepted <= self.failed:
                self.failed = 0  # training has gained enough meanwhile
            return "accepted"
        self.rejected, self.failed = self.rejected + 1, self.tried
        self.steps_lost += step - self.cut_at
        return "rejected"

    def _may_recover(self, left: int, patience: int) -> bool:
        if self.looks < patience:
            # The first evaluation shows no trend yet, and evaluations scatter.
            return self.looks == 1 or self.predicted(left, trust=1.0) >= self.aim - self.tolerated
        return self.predicted(left, TRUST) >= self.aim

    def _wait(self, psnr: float, patience: int) -> None:
        if psnr <= self.best:
            self.stuck += 1
        else:
            self.best, self.stuck = psnr, 0
        # A head without an accepted cut is removed again, and the field below it is at its target.
        proven = self.phase == "field" or self.cuts > 0
        if NO_IMAGE < psnr < self.aim and self.stuck >= patience and proven:
            # Half of the tolerated drop below it, because the field would have gone on losing.
            self.lowered = psnr - 0.5 * self.tolerated

    @classmethod
    def from_state(cls, state: Any) -> SearchProgress:
        """The progress that a checkpoint holds as a dict.

        Raises:
            CheckpointError: it holds none, or a damaged one.
        """
        if not isinstance(state, Mapping):
            raise CheckpointError("the checkpoint is of a run without a budget search; load it with its own method")
        try:
            if set(state) != {f.name for f in fields(cls)}:
                raise ValueError("other entries")
            search = cls(**{**state, "curve": [Point(**point) for point in state["curve"]]})
            if search.phase not in ("before", "degrees", "field", "head", "done") or not -1 <= search.degree <= 4:
                raise ValueError("unknown phase or degree")
            if search.head_size not in ("", *SIZES) or not -1 <= search.num_features <= 1024:
                raise ValueError("unknown head")
            if any(len(look) != 2 or not look[0] > 0 or not math.isfinite(sum(look)) for look in search.trail):
                raise ValueError("an impossible evaluation")
            for f in fields(cls):
                kinds = _KINDS.get(str(f.type))
                if kinds is not None and not isinstance(getattr(search, f.name), kinds):
                    raise ValueError(f"{f.name} is no {f.type}")
        except (TypeError, ValueError, KeyError, AttributeError) as error:
            raise CheckpointError(f"the checkpoint holds a damaged budget search ({error}); give another") from error
        return search
