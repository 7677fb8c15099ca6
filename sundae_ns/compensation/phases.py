"""Pictures that hang less on where the camera's pixels lie.

A U-Net that folds and pools pixels makes something else of a picture that is moved by one pixel, which shows as flicker when
the camera moves. The mean over pictures that were moved, each moved back, hangs less on where they lay.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from sundae_ns.compensation.head import PHASES, CompensationHead


def over_phases(head: CompensationHead, base: Tensor, splatted: Tensor, alpha: Tensor) -> Tensor:
    """The head's picture, or the mean of several; arguments and result are those of :meth:`CompensationHead.forward`.

    ``head.config.phases`` says how many. For pictures that are only looked at: training sees one at a time.
    """
    moves = PHASES[head.config.phases]
    if len(moves) == 1:
        return head(base, splatted, alpha)
    height, width, _ = base.shape
    step = max(head.config.pixel_unshuffle // 2, 1)
    total = torch.zeros_like(base)
    for top, left in ((step * y, step * x) for y, x in moves):
        # Empty space beyond the edges, as the convolutions pad; one size for all, since each is recorded for itself.
        around = (0, 0, left, step - left, top, step - top)
        seen = head(*(F.pad(picture, around) for picture in (base, splatted, alpha)))
        total += seen[top : top + height, left : left + width]
    return total / len(moves)
