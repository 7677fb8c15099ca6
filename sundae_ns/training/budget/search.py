"""How few primitives a scene needs: cut, let training recover, look at held-back views, go on or step back.

Right after a cut a field is far worse than after some training, and how much worse says little about where it ends. So a
cut is judged by what training makes of it: it is accepted as soon as the held-back views reach the target again. Until then
it may take what time there is, as long as it is foreseen to get there: recovery is close to a line over the logarithm of
the steps since the cut, and half of the gain that this promises is counted on. What is not foreseen to recover is taken
back, and so is what has not when time is up; the field that is gone back to then has reached the target before. Steps
behind an accepted cut are the fine-tuning itself; only those behind a cut that is taken back are lost.

A field with more primitives than its scene needs may fit what the training views have by chance, and lose the target on
others while it is trained on. Where one stays below and gains no more, what it has left takes the target's place.

How deep to cut follows from the cut before: what it cost once recovered, per halving, against the margin that there is.
Where the margin is too small for a cut worth its while, training goes on until it has grown, or grows no more: then the least
cut is tried.

This module holds the decisions, as plain numbers; :mod:`sundae_ns.training.budget` acts on them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

from sundae_ns.compensation.head import SIZES
from sundae_ns.errors import CheckpointError

DEEPEST, SHALLOWEST = 1.0, 0.15
"""Halvings of the deepest cut (a half goes), and of the least that is worth a cut (a tenth goes)."""

TRUST = 0.5
"""Share of a foreseen gain that is counted on once ``patience`` has ended; before that, all of it."""

NO_PICTURE = 0.0
"""PSNR of a look at pictures that are not all numbers, dB: none whose values are in [0, 1] is worse."""

FORMER = {"last_psnr"}
"""Entries of states that older versions have written, without a use today."""
REQUIRED = {"phase", "reference", "target", "accepted", "degree", "curve"}
"""Entries that the states of all versions have; others are as in a new search where they are missing."""

_KINDS: dict[str, tuple[type, ...]] = {"int": (int,), "float": (int, float), "bool": (bool,)}

Phase = Literal["before", "bands", "field", "head", "done"]
Verdict = Literal["accepted", "waiting", "rejected", "resting"]


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
    lowered: float = math.nan
    """PSNR that takes the target's place while that is out of reach of the field itself, dB; else not a number."""
    best: float = math.nan
    """Highest PSNR of the field since it was last cut or restored, dB."""
    stuck: int = 0
    """Looks since then that were no higher."""
    trying: bool = False
    """Whether a cut waits for its verdict."""
    looks: int = 0
    """Looks since the last cut, or since the last verdict."""
    trail: list[list[float]] = field(default_factory=list)
    """Looks since the last cut: steps of training since then, and PSNR in dB."""
    margin: float = math.nan
    """What the field was above the target before the last cut, dB."""
    slope: float = 0.0
    """What a halving cost after recovery, seen or foreseen, dB, by the last verdict."""
    rejected: int = 0
    """Cuts taken back in this phase."""
    failed: int = 0
    """Primitives of the last cut of this phase that was taken back; 0 where none was, or where a later one went as far."""
    cuts: int = 0
    """Cuts accepted in this phase."""
    accepted: int = 0
    """Primitives of the field that training would go back to."""
    tried: int = 0
    """Primitives after the last cut."""
    cut_at: int = 0
    """Step of the schedule of the last cut."""
    head: bool = False
    """Whether the head takes part."""
    head_at: int = 0
    """Step of the schedule at which it joined."""
    lost_at_join: int = 0
    """``steps_lost`` at that step."""
    head_size: str = ""
    """Size that was chosen for it; empty before."""
    num_features: int = -1
    """Length of the feature vectors that was chosen; -1 before."""
    head_dropped: bool = False
    """Whether it was decided that this scene needs no head."""
    degree: int = -1
    """Degree of the harmonics of the field at hand; -1 before the search."""
    before: int = 0
    """Primitives of the warm-up field."""
    steps_lost: int = 0
    """Steps of training behind what was taken back."""
    seconds: float = 0.0
    """Time that looking, scoring and cutting took, training not counted."""
    views: int = 0
    """Held-back views."""
    dropped_nonfinite: int = 0
    """Primitives that went because a parameter of theirs was NaN or infinite."""
    zeroed: int = 0
    """Primitives whose bands above 0 were found to carry nothing, and were set to 0."""
    degrees: dict[str, float] = field(default_factory=dict)
    """PSNR by degree of the harmonics, dB, each after the same training of the warm-up field."""
    curve: list[Point] = field(default_factory=list)

    @property
    def searching(self) -> bool:
        """Whether something is being tried."""
        return self.phase in ("bands", "field", "head")

    def begin(self, phase: Literal["field", "head"], accepted: int) -> None:
        """Start to cut a field that meets the target; what a halving costs is remembered from an earlier phase."""
        self.phase, self.accepted, self.trying = phase, accepted, False
        self.rejected, self.failed, self.cuts, self.looks = 0, 0, 0, 0
        self.lowered, self.best, self.stuck = math.nan, math.nan, 0

    @property
    def tolerated(self) -> float:
        """What may be lost, dB."""
        return self.reference - self.target

    @property
    def aim(self) -> float:
        """PSNR that a cut has to keep, dB."""
        return self.target if math.isnan(self.lowered) else self.lowered

    @property
    def before_cut(self) -> float:
        """PSNR of the field before the last cut, dB."""
        return self.aim + self.margin

    def next_degree(self, top: int, tolerated: float) -> int | None:
        """The degree to try next, None when the lowest that does is known: bisection, all bands first.

        Args:
            top: degree of the warm-up field.
            tolerated: what may be lost against all bands, dB.
        """
        if str(top) not in self.degrees:
            return top
        best, worst = self.lowest_degree(top, tolerated), -1
        for name, value in self.degrees.items():
            if value < self._of_all_bands(top) - tolerated:
                worst = max(worst, int(name))
        return None if best - worst <= 1 else (best + worst) // 2

    def lowest_degree(self, top: int, tolerated: float) -> int:
        """The lowest degree among those tried that loses no more than is tolerated."""
        enough = self._of_all_bands(top) - tolerated
        return min((int(name) for name, value in self.degrees.items() if value >= enough), default=top)

    def _of_all_bands(self, top: int) -> float:
        value = self.degrees[str(top)]
        return value if value > NO_PICTURE else self.reference

    def next_count(self, psnr: float, least: int, patience: int) -> int | None:
        """Primitives after the next cut; None if the margin is too small for one, or there is nothing left to cut.

        Args:
            psnr: of the field that would be cut, dB.
            least: fewest primitives.
            patience: looks without a gain after which the least cut is tried.
        """
        margin = psnr - self.aim
        if margin < 0:
            return None
        halvings = DEEPEST if margin >= self.slope * DEEPEST else margin / self.slope
        if self.stuck >= patience or not math.isnan(self.lowered):
            halvings = max(halvings, SHALLOWEST)  # to wait longer would change nothing
        if self.failed:
            # Half the way to what has failed; no nearer to it, in the least steps: training may have gained.
            halvings = min(halvings, max(0.5 * math.log2(self.accepted / self.failed), SHALLOWEST))
        count = max(int(self.accepted * 0.5**halvings), least)
        return count if halvings >= SHALLOWEST and count < self.accepted else None

    def cut(self, psnr: float, count: int, step: int) -> None:
        """A field was cut to ``count`` primitives after this step of the schedule."""
        self.margin, self.tried, self.cut_at, self.trying, self.looks = psnr - self.aim, count, step, True, 0
        self.trail = []

    def foreseen(self, left: int, trust: float) -> float:
        """PSNR of the field that is tried after so many steps more, dB.

        The line of least squares through the looks over the logarithm of the steps since the cut; with one look, what it saw.

        Args:
            left: steps to come.
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
        """Judge the last cut, if it waits for it, by a look at the held-back views.

        Args:
            psnr: mean over the views, dB.
            step: of the schedule.
            left: steps of training that the cut has to recover in.
            patience: looks for which a cut is given the benefit of the doubt.
        """
        self.looks += 1
        if psnr >= self.target:
            self.lowered = math.nan
        if not self.trying:
            self._rest(psnr, patience)
            return "resting"
        self.trail.append([step - self.cut_at, psnr])
        margin, seen = psnr - self.aim, psnr > NO_PICTURE
        if margin < 0 and left > 0 and seen and self._may_recover(left, patience):
            return "waiting"
        self.trying, self.looks, self.best, self.stuck = False, 0, math.nan, 0
        recovered = margin if margin >= 0 else self.foreseen(max(left, 0), TRUST) - self.aim
        if seen:
            # Training gains meanwhile, and a lucky cut does not make the next one cheap.
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
            # The first look has nothing to compare with: what a cut costs is not what training gains. And looks scatter.
            return self.looks == 1 or self.foreseen(left, trust=1.0) >= self.aim - self.tolerated
        return self.foreseen(left, TRUST) >= self.aim

    def _rest(self, psnr: float, patience: int) -> None:
        if psnr <= self.best:
            self.stuck += 1
        else:
            self.best, self.stuck = psnr, 0
        # A head that has not proven itself yet goes again, and the field that it joined is at its target.
        proven = self.phase == "field" or self.cuts > 0
        if NO_PICTURE < psnr < self.aim and self.stuck >= patience and proven:
            # Less by half of what may be lost: the field would have gone on losing.
            self.lowered = psnr - 0.5 * self.tolerated

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
            known = {name: value for name, value in state.items() if name not in FORMER}
            if not REQUIRED <= set(known) <= {f.name for f in fields(cls)}:
                raise ValueError("other entries")
            search = cls(**{**known, "curve": [Point(**point) for point in known["curve"]]})
            if search.phase not in ("before", "bands", "field", "head", "done") or not -1 <= search.degree <= 4:
                raise ValueError("unknown phase or degree")
            if search.head_size not in ("", *SIZES) or not -1 <= search.num_features <= 1024:
                raise ValueError("unknown head")
            if any(len(look) != 2 or not look[0] > 0 or not math.isfinite(sum(look)) for look in search.trail):
                raise ValueError("a look that nobody took")
            for f in fields(cls):
                kinds = _KINDS.get(str(f.type))
                if kinds is not None and not isinstance(getattr(search, f.name), kinds):
                    raise ValueError(f"{f.name} is no {f.type}")
        except (TypeError, ValueError, KeyError, AttributeError) as error:
            raise CheckpointError(
                f"the checkpoint does not say where its search for a budget stood ({error}); give another"
            ) from error
        return search
