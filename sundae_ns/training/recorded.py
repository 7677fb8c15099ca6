"""Whole training steps outside of nerfstudio's loop: the step, gradients, densification's statistics, and Adam.

They run as CUDA graphs on one GPU. A graph reads fixed addresses, so the field lies in buffers.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from sundae_ns.compensation import CompensationHead
from sundae_ns.gaussians.gaussians import Field
from sundae_ns.gpu.adam import Update, adam_step
from sundae_ns.rasterization import Capacity
from sundae_ns.rendering.render import LocalField, RenderSettings, degree_in_use
from sundae_ns.training.buffers import MOMENTS, Buffers, start_moments, trained_parameters
from sundae_ns.training.densification import COUNTED, count_view, start_counting
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.losses import StepLosses
from sundae_ns.training.recordings import StepRecordings
from sundae_ns.training.step import StepInputs, StepResult, TrainingStep

HEAD = "compensation"
"""Name of the head's optimizer."""


@dataclass(frozen=True)
class _Held:
    """The tensors of a state whose field lies in the buffers, to notice cheaply when one is replaced."""

    trained: tuple[str, ...]
    """Names of the parameters of the field that are trained."""
    growing: bool
    """Whether the buffers have spare rows."""
    groups: list[tuple[str, torch.optim.Optimizer, dict[str, Any]]]
    """Groups of parameters that a step trains: name of the optimizer, optimizer, group."""
    tensors: list[tuple[Mapping[Any, Any], Any, Any]]
    """Mapping, key and value of everything that surgery and restored snapshots replace."""
    addresses: Hashable
    """What a recording reads beside the buffers: the head's weights, and the counts of steps."""

    @classmethod
    def of(cls, state: FieldState, trained: tuple[str, ...], head: CompensationHead | None) -> _Held:
        names = trained if head is None else (*trained, HEAD)
        groups = [
            (name, state.optimizers[name], group) for name in names for group in state.optimizers[name].param_groups
        ]
        members = [(optimizer.state, value) for _, optimizer, group in groups for value in group["params"]]
        states = [(held, value, held[value]) for held, value in members]
        tensors: list[tuple[Mapping[Any, Any], Any, Any]] = [
            *states,
            *((state.field, name, state.field[name]) for name in trained),
            *((state.densification, *item) for item in state.densification.items() if isinstance(item[1], Tensor)),
        ]
        addresses = tuple(own[name].data_ptr() for _, _, own in states for name in (*MOMENTS, "step"))
        return cls(trained, state.densifying, groups, tensors, (addresses, None if head is None else head.addresses()))

    def unchanged(self, state: FieldState, settings: RenderSettings) -> bool:
        """Whether the state still consists of these tensors."""
        with_head = self.groups[-1][0] == HEAD
        return (
            self.growing == state.densifying
            and with_head == (settings.head is not None)
            and all(mapping.get(key) is value for mapping, key, value in self.tensors)
            and self.trained == trained_parameters(state)
        )


class RecordedStep:
    """Training steps of one field.

    Args:
        losses: terms of the loss.
        record: False runs every step kernel by kernel, as a test does on a CPU.
    """

    def __init__(self, losses: StepLosses, *, record: bool = True) -> None:
        self._losses = losses
        self._buffers = Buffers()
        self._held: _Held | None = None
        self._recordings = StepRecordings(record=record)

    def __call__(self, state: FieldState, inputs: StepInputs, settings: RenderSettings) -> StepResult:
        """Train one step.

        Args:
            state: the field. Afterwards its tensors are rows of this object's buffers, and ``info`` says that the
                statistics of densification are counted.
            inputs: of this step; learning rates are those of the optimizers.
            settings: of training images, with the backend gsplat for recording.

        Raises:
            BackendError: the step cannot be recorded. Nothing has changed.
            torch.cuda.OutOfMemoryError: the same.
        """
        held = self._held
        if held is None or not held.unchanged(state, settings):
            held = self._held = self._hold(state, settings)
        # Pinned: copying from other memory would wait until the GPU has finished the last step.
        numbers = torch.tensor(
            [*(float(group["lr"]) for _, _, group in held.groups), float(state.field.num_primitives)],
            pin_memory=state.device.type == "cuda",
        ).to(state.device, non_blocking=True)
        # The prior of a field that grows is a mean over fewer rows than the buffers have.
        count = numbers[-1] if state.densifying and self._losses.prior_weight(state) > 0 else None
        result = self._recordings.run(
            partial(self._step, state, held),
            replace(inputs, rates=numbers[:-1], count=count),
            settings,
            kind=_kind(state, inputs, settings),
            addresses=held.addresses,
        )
        state.info = {COUNTED: True}
        return result

    def _hold(self, state: FieldState, settings: RenderSettings) -> _Held:
        """Let the field be rows of the buffers, with all states that its optimizers need."""
        trained = trained_parameters(state)
        start_moments(state, trained if settings.head is None else (*trained, HEAD))
        if state.densifying:
            start_counting(state.densification, state.field["means"])
        if self._buffers.hold(state, trained, growing=state.densifying):
            self._recordings.forget(pairs=not state.densifying)  # a pruned field needs far fewer pairs
        return _Held.of(state, trained, settings.head)

    def _step(
        self, state: FieldState, held: _Held, inputs: StepInputs, settings: RenderSettings, capacity: Capacity | None
    ) -> StepResult:
        """One step on the buffers; all of its work is recorded."""
        tensors, head, view = self._buffers.tensors, settings.head, inputs.view
        trained = {name: tensors[name] for name in held.trained}
        # With parameters that have no values, such as the features of a field without a head.
        empty = {name: value for name, value in state.field.items() if name not in trained and value.numel() == 0}
        field = Field(trained, state.field.encoding)
        source = LocalField(Field({**empty, **trained}, state.field.encoding))
        step = TrainingStep(source, state, self._losses, field)
        loss, splatted, result = step(inputs, settings)
        network = [] if head is None else list(head.parameters())
        counting, centers = state.densifying and "grad2d" in tensors, splatted.info["means2d"]
        wanted = [*field.values(), *network, *([centers] if counting else [])]
        grads = torch.autograd.grad(loss, wanted, allow_unused=True)
        with torch.no_grad():
            overflow = self._recordings.overflow(capacity)
            if counting:
                of_centers, radii = centers.absgrad if settings.absgrad else grads[-1], splatted.info["radii"]
                radii = radii if overflow is None else radii * (overflow == 0)
                count_view(tensors, of_centers[0], radii[0], view.width, view.height)
            assert inputs.rates is not None
            updates = self._updates(held, dict(zip([*field.values(), *network], grads, strict=False)))
            adam_step(updates, inputs.rates, overflow)
        return result

    def _updates(
        self, held: _Held, grads: Mapping[Tensor, Tensor | None]
    ) -> list[tuple[Mapping[str, Any], list[Update]]]:
        """Groups of parameters with their updates, on whole buffers."""
        tensors = self._buffers.tensors
        groups: list[tuple[Mapping[str, Any], list[Update]]] = []
        for name, optimizer, group in held.groups:
            updates = []
            for value in group["params"]:
                whole, own = tensors.get(name, value), optimizer.state[value]
                grad = grads.get(whole)
                if grad is None:
                    continue
                if grad.stride() != whole.stride():  # kernels walk through all tensors in the order of memory
                    grad = torch.empty_like(whole).copy_(grad)
                mean, square = (tensors.get(f"{name}.{moment}", own[moment]) for moment in MOMENTS)
                updates.append(Update(whole, grad, mean, square, own["step"]))
            groups.append((group, updates))
        return groups


def _kind(state: FieldState, inputs: StepInputs, settings: RenderSettings) -> Hashable:
    """What decides on the kernels of a step, beside numbers of primitives."""
    view, head = inputs.view, settings.head
    degree = degree_in_use(state.field.sh_degree, settings.active_sh_degree)
    return (
        (view.width, view.height, inputs.mask is not None, degree, settings.antialiased, settings.absgrad),
        (state.densifying, state.pruned, state.head_enabled),
        None if head is None else (head.net, *vars(head.config).values()),
    )
