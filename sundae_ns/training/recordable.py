"""What every recorded step is made of: inputs that stay in place, the way from view to loss, results, and counts of pairs."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sundae_ns.gaussians.field import Field
from sundae_ns.rasterization import Capacity, Rasterization
from sundae_ns.rendering.render import RenderSettings, render
from sundae_ns.rendering.source import FieldSource
from sundae_ns.rendering.views import View
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.losses import StepLosses

SPARE_PAIRS = 2.0
"""Capacity for tile/primitive pairs, as a multiple of the most that a view has needed."""


@dataclass(frozen=True)
class StepInputs:
    """What a step trains on."""

    view: View
    target: Tensor
    """The truth over the background ``[H, W, 3]``."""
    mask: Tensor | None
    """Pixels that count, float ``[H, W, 1]``; None for all."""
    background: Tensor
    """Colour ``[3]``."""

    def clone(self) -> StepInputs:
        """A copy, so that a recording reads it where it stays."""
        view, mask = self.view, self.mask
        return StepInputs(
            view._replace(viewmat=view.viewmat.clone(), K=view.K.clone()),
            self.target.detach().clone(memory_format=torch.contiguous_format),
            None if mask is None else mask.clone(memory_format=torch.contiguous_format),
            self.background.clone(),
        )

    def copy_to(self, other: StepInputs) -> None:
        """Write these into the inputs of a recording."""
        pairs = [(other.view.viewmat, self.view.viewmat), (other.view.K, self.view.K)]
        pairs += [(other.background, self.background), (other.target, self.target)]
        if self.mask is not None and other.mask is not None:
            pairs.append((other.mask, self.mask))
        torch._foreach_copy_([own for own, _ in pairs], [value.detach() for _, value in pairs])


@dataclass(frozen=True)
class StepResult:
    """Images and losses of a step; the next step overwrites them."""

    images: dict[str, Tensor]
    """``rgb``, ``base_rgb`` and ``accumulation``, each ``[H, W, C]``."""
    losses: dict[str, Tensor]
    """Terms of the loss ``[]``."""
    loss: Tensor
    """Their sum ``[]``."""


def forward(
    source: FieldSource,
    state: FieldState,
    field: Field | Mapping[str, Tensor],
    losses: StepLosses,
    inputs: StepInputs,
    settings: RenderSettings,
) -> tuple[Tensor, Rasterization, StepResult]:
    """Render a view and compare it with the truth.

    Args:
        source: of the primitives.
        state: says what is enabled at this step.
        field: trained parameters, for the terms that see them.
        losses: terms of the loss.
        inputs: of this step.
        settings: of training.

    Returns:
        The loss ``[]`` with its graph, the rasteriser's result, and the detached result of the step.
    """
    with torch.enable_grad():
        images, splatted = render(source, inputs.view, inputs.background, settings, depth=False)
        terms = losses(state, field, images["rgb"], images["base_rgb"], inputs.target, inputs.mask)
        loss = functools.reduce(torch.add, terms.values())
    shown = {name: images[name].detach() for name in ("rgb", "base_rgb", "accumulation")}
    return loss, splatted, StepResult(shown, {name: value.detach() for name, value in terms.items()}, loss.detach())


class NeededPairs:
    """Most tile/primitive pairs that a view has needed, on the device and, some steps later, on the host."""

    def __init__(self) -> None:
        self._on_device: Tensor | None = None
        """int64 ``[]``, as its pinned copy."""
        self._on_host: Tensor | None = None

    @property
    def most(self) -> int:
        """The number, as far as the host knows it."""
        assert self._on_host is not None
        return int(self._on_host)

    def count(self, capacity: Capacity, device: torch.device, *, anew: bool = False) -> None:
        """Count the pairs of a step that ran kernel by kernel, which waits for the GPU.

        Args:
            capacity: without a limit; it was rendered with.
            device: of the step.
            anew: forget the steps before.
        """
        needed = max(int(number) for number in capacity.needed)
        if self._on_device is None or self._on_host is None:
            self._on_device = torch.zeros((), dtype=torch.int64, device=device)
            self._on_host = torch.zeros((), dtype=torch.int64, pin_memory=True)
        most = needed if anew else max(needed, int(self._on_device))
        self._on_device.fill_(most)
        self._on_host.fill_(most)

    @torch.no_grad()
    def overflow(self, capacity: Capacity | None) -> Tensor | None:
        """1 if the lists of tiles were too short, so that the step must change nothing, else 0; float ``[]``."""
        if capacity is None or capacity.pairs is None:
            return None
        assert self._on_device is not None
        assert self._on_host is not None
        needed = torch.stack(capacity.needed).amax()
        torch.maximum(self._on_device, needed, out=self._on_device)
        self._on_host.copy_(self._on_device, non_blocking=True)
        return (needed > capacity.pairs).float()
