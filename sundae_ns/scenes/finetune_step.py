"""One step of a fine-tune: rounding, the training step, the rate and Adam, as one CUDA graph where that is possible.

The model holds rounded values, the ones that a reader decodes. Adam moves exact values beside them, by the gradients at
the rounded ones (the straight-through estimator of Bengio, Leonard and Courville, 2013). So losses and rasteriser do
not know of rounding.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from sundae_ns.errors import BackendError
from sundae_ns.model import SundaeModel
from sundae_ns.rasterization import Capacity
from sundae_ns.rendering.render import RenderSettings
from sundae_ns.storage.packing import Codecs
from sundae_ns.storage.packing.rate import estimated_bits
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.recordings import StepRecordings
from sundae_ns.training.step import StepInputs, StepResult

_log = logging.getLogger(__name__)


class Through(NamedTuple):
    """Parameters of the model, which hold rounded values, and the exact values that are trained."""

    shown: Mapping[str, Tensor]
    exact: dict[str, Tensor]
    rounded: Callable[[Mapping[str, Tensor]], Mapping[str, Tensor]]

    @classmethod
    def of(
        cls, shown: Mapping[str, Tensor], rounded: Callable[[Mapping[str, Tensor]], Mapping[str, Tensor]]
    ) -> Through:
        """Start with the values of the parameters."""
        return cls(shown, {name: value.detach().clone().requires_grad_() for name, value in shown.items()}, rounded)

    @torch.no_grad()
    def show(self) -> None:
        """Round into the parameters in place, because recorded graphs read them there."""
        rounded = self.rounded(self.exact)
        for name, value in self.shown.items():
            value.copy_(rounded[name])

    @torch.no_grad()
    def set_gradients(self, at_rounded: Mapping[str, Tensor | None], of_rate: Mapping[str, Tensor | None]) -> None:
        """Set the gradients of the exact values: those at the rounded ones and those of the rate."""
        for name, value in self.exact.items():
            gradient, second = at_rounded.get(name), of_rate.get(name)
            if gradient is not None and name == "quats":
                # Rounding may have negated a quaternion, which is the same rotation.
                gradient = gradient * (value * self.shown[name]).sum(dim=1, keepdim=True).sign()
            if second is not None:
                gradient = second if gradient is None else gradient + second
            if gradient is not None and name == "features_rest":
                # Keep view-independent colours so: their coefficients cost next to nothing in the pack.
                gradient = gradient.masked_fill((value == 0).flatten(1).all(dim=1)[:, None, None], 0.0)
            value.grad = gradient


class TunedStep:
    """Steps of a fine-tune.

    Args:
        model: shows the rounded values; its other parameters do not change.
        codecs: round the values, on the model's device.
        field: its parameters.
        head: those of its head; empty without one.
        optimizer: Adam of the exact values; on CUDA with rates in memory.
        rate: loss for each bit.
    """

    def __init__(
        self,
        model: SundaeModel,
        codecs: Codecs,
        field: Through,
        head: Through,
        optimizer: torch.optim.Optimizer,
        rate: float,
    ) -> None:
        self._model, self._codecs, self._field, self._head = model, codecs, field, head
        self._optimizer, self._rate = optimizer, rate
        self._can_record = model.device.type == "cuda" and model.backend.name == "gsplat"
        self._recordings = StepRecordings()

    def __call__(self, state: FieldState, inputs: StepInputs, settings: RenderSettings) -> StepResult:
        """Train on one image.

        Raises:
            torch.cuda.OutOfMemoryError: the GPU's memory is full.
        """
        if self._can_record:
            self._recordings.keep_for(self._model.losses.emphasis(state))
            kind = (inputs.view.width, inputs.view.height, inputs.mask is not None)
            try:
                return self._recordings.run(self._run, inputs, settings, kind=kind)
            except BackendError as error:
                _log.warning("the fine-tune runs kernel by kernel, slower: %s", error)
                self._can_record = False
        return self._run(inputs, settings, None)

    def _run(self, inputs: StepInputs, settings: RenderSettings, capacity: Capacity | None) -> StepResult:
        """One step; all of its work is recorded."""
        self._field.show()
        self._head.show()
        loss, _, result = self._model.training_step(inputs, settings)
        self._set_gradients(loss)
        # torch's Adam reads this name: it changes nothing where it is 1.
        self._optimizer.found_inf = self._recordings.overflow(capacity)  # type: ignore[attr-defined]
        self._optimizer.step()
        return result

    def _set_gradients(self, loss: Tensor) -> None:
        both = (self._field, self._head)
        at_rounded = _gradients(loss, [part.shown for part in both])
        of_rate: list[dict[str, Tensor | None]] = [{}, {}]
        if self._rate > 0:
            with torch.enable_grad():
                bits = estimated_bits(self._codecs, self._field.exact, self._head.exact)
                total = self._rate * torch.stack(list(bits.values())).sum()
            of_rate = _gradients(total, [part.exact for part in both])
        for part, gradients, others in zip(both, at_rounded, of_rate, strict=True):
            part.set_gradients(gradients, others)


def _gradients(loss: Tensor, groups: list[Mapping[str, Tensor]]) -> list[dict[str, Tensor | None]]:
    """Gradients of a loss by the values of each group; None where it does not depend on them."""
    found = iter(torch.autograd.grad(loss, [value for group in groups for value in group.values()], allow_unused=True))
    return [{name: next(found) for name in group} for group in groups]
