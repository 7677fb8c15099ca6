"""Values beyond the finite numbers: those with a meaning become finite, and primitives without a meaning are left out.

Files of other programs hold them: a logit of an opacity of 1, or the logarithm of a flat primitive's width.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sundae_ns.gaussians.field import Field, as_field
from sundae_ns.gaussians.parameters import finite_mask

LARGEST_LOGIT = 16.0
"""Logit for opacities of 0 and 1. Its float32 opacity is the last below 1, so that its logarithms stay finite."""
LEAST_SCALES = (-80.0, -43.0)
"""Range of the log-scale for widths of 0: as narrow as the narrowest of the field, and with a square that is a normal
float32, unless a tiny scene needs less."""
_QUATERNION_RANGE = 1e-6, 1e18
"""Largest components of quaternions that can be normalised in float32."""


class Mended(NamedTuple):
    """A field whose values are finite, and what that took."""

    field: Field
    """The primitives that have a meaning ``[M, ...]``; the tensors of the source if nothing changed."""
    mask: Tensor
    """True for these primitives of the source, bool ``[N]``."""
    limits: int
    """Number of these primitives with an opacity of exactly 0 or 1, which was clamped."""
    flat: int
    """Number of these primitives with a width of 0, which was clamped."""
    unrotated: int
    """Number of these primitives with an all-zero quaternion, which became the identity."""

    @property
    def dropped(self) -> int:
        """Number of primitives that were left out: NaN, or infinite where that has no meaning."""
        return len(self.mask) - self.field.num_primitives

    @property
    def clamped(self) -> bool:
        """Whether a value was replaced."""
        return self.limits + self.flat + self.unrotated > 0

    def summary(self) -> str:
        """What was clamped and dropped, as part of a sentence; empty if nothing was."""
        kinds = {"opacity 0 or 1": self.limits, "width 0": self.flat, "rotation 0": self.unrotated}
        named = " and ".join(f"{number:,} with {name}" for name, number in kinds.items() if number)
        parts = [f"clamped {named} to finite values"] if named else []
        if self.dropped:
            parts.append(f"dropped {self.dropped:,} that were not finite (NaN or infinite)")
        return f"{len(self.mask):,} primitives: {', '.join(parts)}" if parts else ""


@torch.no_grad()
def mend(params: Mapping[str, Any]) -> Mended:
    """The primitives of a field that have a meaning, with finite values.

    - A logit of plus or minus infinity is an opacity of 1 or 0, and becomes plus or minus :data:`LARGEST_LOGIT`.
    - A log-scale of minus infinity is a width of 0, and becomes the least of the field within :data:`LEAST_SCALES`.
    - An all-zero quaternion does not rotate, as in the renderers of 3DGS, and becomes the identity. One that is too
      short or too long to be normalised in float32 is rescaled.
    - A primitive with any other value that is NaN or infinite is left out.

    Args:
        params: the field, N primitives; it does not change.
    """
    field = as_field(params)
    values: dict[str, Tensor] = {}
    opacities, scales, quats = (field[name].detach() for name in ("opacities", "scales", "quats"))
    n, device = field.num_primitives, field["means"].device
    nothing = torch.zeros(n, dtype=torch.bool, device=device)
    limits, flat, unrotated = nothing, nothing, nothing
    infinite = opacities.isinf()
    if bool(infinite.any()):
        limits = infinite.flatten(1).any(dim=1)
        values["opacities"] = torch.where(infinite, opacities.clamp(-LARGEST_LOGIT, LARGEST_LOGIT), opacities)
    narrow = scales.isneginf()
    if bool(narrow.any()):
        flat = narrow.any(dim=1)
        narrowest = torch.where(scales.isfinite(), scales, LEAST_SCALES[1]).amin().clamp(*LEAST_SCALES)
        values["scales"] = torch.where(narrow, narrowest, scales)
    if n:
        largest = quats.abs().amax(dim=1)
        least, most = _QUATERNION_RANGE
        odd = ((largest < least) | (largest > most)) & largest.isfinite()
        if bool(odd.any()):
            unrotated = largest == 0
            rescaled = quats / torch.where(odd, largest, 1.0).clamp_min(torch.finfo(quats.dtype).tiny)[:, None]
            # The identity: w is 1, the others stay 0.
            rescaled[:, 0] += unrotated.to(rescaled)
            values["quats"] = torch.where(odd[:, None], rescaled, quats)
    mended = field.replaced(values) if values else field
    mask = finite_mask(mended)
    whole = bool(mask.all())
    counts = (int((kind & mask).sum()) for kind in (limits, flat, unrotated))
    return Mended(mended if whole else mended.rows(mask), mask, *counts)
