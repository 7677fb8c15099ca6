"""A training step as one CUDA graph: rendering, head, loss, gradients, densification's statistics, and Adam.

A step is some two hundred small kernels. Launched one by one from Python they take several times as long as the GPU works.
The graph reads the view, the truth, the background and the learning rates where the last call has put them.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sundae_ns.compensation import CompensationHead
from sundae_ns.gaussians.field import Field
from sundae_ns.gpu.cuda_graphs import record, warm_up
from sundae_ns.gpu.fused_adam import adam
from sundae_ns.rasterization import Capacity, RecordableGsplat
from sundae_ns.rendering.render import RenderSettings
from sundae_ns.rendering.source import LocalField, degree_in_use
from sundae_ns.training.buffers import MOMENTS, Buffers, start_moments, trained_parameters
from sundae_ns.training.densification import COUNTED, count_view, start_counting
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.losses import StepLosses
from sundae_ns.training.recordable import SPARE_PAIRS, NeededPairs, StepInputs, StepResult, forward

MAX_RECORDINGS = 8
"""Recordings kept at a time: one for each image size and SH degree in use."""

UNUSED = 1000
"""Steps after which an unused recording makes room. Where more sizes are in use than fit, the others run kernel by kernel,
because recording takes longer than a step."""

HEAD = "compensation"
"""Name of the head's optimizer."""


@dataclass(frozen=True)
class _Recording:
    graph: torch.cuda.CUDAGraph
    inputs: StepInputs
    """The graph reads them here."""
    rates: Tensor
    """Learning rates in the order of :attr:`_Held.groups`."""
    result: StepResult
    pairs: int
    """Tile/primitive pairs that fit."""


@dataclass(frozen=True)
class _Held:
    """The tensors of a state whose field lies in the buffers, to notice cheaply when one is replaced."""

    trained: tuple[str, ...]
    """Names of the parameters of the field that are trained."""
    growing: bool
    """Whether the buffers have spare rows."""
    groups: list[tuple[str, torch.optim.Optimizer, dict[str, Any]]]
    """Groups of parameters that a step trains: name of the optimizer, optimizer, group."""
    parameters: list[tuple[str, Tensor]]
    statistics: list[tuple[str, Tensor]]
    states: Sequence[tuple[Mapping[Tensor, Any], Tensor, dict[str, Any]]]
    """States of an optimizer, a parameter, and its state."""
    addresses: Hashable
    """What a recording reads beside the buffers: the head's weights, and the counts of steps."""

    @classmethod
    def of(cls, state: FieldState, trained: tuple[str, ...], head: CompensationHead | None, *, growing: bool) -> _Held:
        names = trained if head is None else (*trained, HEAD)
        groups = [
            (name, state.optimizers[name], group) for name in names for group in state.optimizers[name].param_groups
        ]
        values = [(optimizer, value) for _, optimizer, group in groups for value in group["params"]]
        states = [(optimizer.state, value, optimizer.state[value]) for optimizer, value in values]
        addresses = tuple(own[name].data_ptr() for _, _, own in states for name in (*MOMENTS, "step"))
        return cls(
            trained,
            growing,
            groups,
            [(name, state.field[name]) for name in trained],
            [(name, value) for name, value in state.densification.items() if isinstance(value, Tensor)],
            states,
            (addresses, None if head is None else head.addresses()),
        )

    @property
    def rates(self) -> list[float]:
        """Learning rates of the groups."""
        return [float(group["lr"]) for _, _, group in self.groups]

    def unchanged(self, state: FieldState, settings: RenderSettings, *, growing: bool) -> bool:
        """Whether the state still consists of these tensors; surgery and restored snapshots put new ones in their place."""
        with_head = self.groups[-1][0] == HEAD
        return (
            growing == self.growing
            and with_head == (settings.head is not None)
            and all(state.field[name] is value for name, value in self.parameters)
            and all(state.densification.get(name) is value for name, value in self.statistics)
            and all(states.get(value) is own for states, value, own in self.states)
            and self.trained == trained_parameters(state)
        )


class RecordedStep:
    """Training steps of one field.

    The first step of a kind runs kernel by kernel, because libraries choose and load kernels then; later ones replay. A step
    whose view has more tile/primitive pairs than fit changes nothing, and the next recording has room for them.

    Args:
        losses: terms of the loss.
        record: False runs every step kernel by kernel, as a test does on a CPU.
    """

    def __init__(self, losses: StepLosses, *, record: bool = True) -> None:
        self._losses = losses
        self._record = record
        self._buffers = Buffers()
        self._held: _Held | None = None
        self._recordings: OrderedDict[Hashable, _Recording] = OrderedDict()
        self._used: dict[Hashable, int] = {}
        """Step at which a recording was last replayed."""
        self._steps = 0
        self._warm: set[Hashable] = set()
        """Kinds of steps that have run kernel by kernel."""
        self._pairs = NeededPairs()
        self._emphasis = 1.0

    def __call__(self, state: FieldState, inputs: StepInputs, settings: RenderSettings) -> StepResult:
        """Train one step.

        Args:
            state: the field. Afterwards its tensors are rows of this object's buffers, and ``info`` says that the
                statistics of densification are counted.
            inputs: of this step.
            settings: of training images, with the backend gsplat for recording.

        Raises:
            BackendError: the step cannot be recorded. Nothing has changed.
            torch.cuda.OutOfMemoryError: the same.
        """
        # A prior is a mean over all rows, so it allows no spare ones.
        growing = state.densifying and self._losses.prior_weight(state) == 0
        held = self._held
        if held is None or not held.unchanged(state, settings, growing=growing):
            held = self._held = self._hold(state, settings, growing=growing)
        emphasis = self._losses.emphasis(state)
        if emphasis != self._emphasis:  # recordings hold the number
            self._forget_recordings()
            self._emphasis = emphasis
        kind = _kind(state, inputs, settings)
        recording = self._recording(kind, state, held, inputs, settings) if kind in self._warm else None
        if recording is None:
            result = self._run(state, held, inputs, settings)
            self._warm.add(kind)
        else:
            inputs.copy_to(recording.inputs)
            # Pinned: copying from other memory would wait until the GPU has finished the last step.
            recording.rates.copy_(torch.tensor(held.rates, pin_memory=True), non_blocking=True)
            recording.graph.replay()
            result = recording.result
        self._steps += 1
        state.info = {COUNTED: True}
        return result

    def _hold(self, state: FieldState, settings: RenderSettings, *, growing: bool) -> _Held:
        """Let the field be rows of the buffers, with all states that its optimizers need."""
        trained = trained_parameters(state)
        start_moments(state, trained if settings.head is None else (*trained, HEAD))
        if state.densifying:
            start_counting(state.densification, state.field["means"])
        if self._buffers.hold(state, trained, growing=growing):
            self._forget_recordings()
            if not growing:  # a pruned field needs far fewer pairs: measure them again
                self._warm.clear()
        return _Held.of(state, trained, settings.head, growing=growing)

    def _forget_recordings(self) -> None:
        self._recordings.clear()
        self._used.clear()

    # ------------------------------------------------------------------------------------------------------ running

    def _run(self, state: FieldState, held: _Held, inputs: StepInputs, settings: RenderSettings) -> StepResult:
        """Run a step kernel by kernel, on the stream of the recordings."""
        device = state.device
        rates = torch.tensor(held.rates, device=device)
        if device.type != "cuda":
            return self._step(state, held, inputs, settings, rates, None)
        capacity = Capacity()
        with warm_up(device):
            result = self._step(
                state, held, inputs, replace(settings, backend=RecordableGsplat(capacity)), rates, capacity
            )
        self._pairs.count(capacity, device, anew=not self._warm)
        return result

    def _recording(
        self, kind: Hashable, state: FieldState, held: _Held, inputs: StepInputs, settings: RenderSettings
    ) -> _Recording | None:
        """The recording of a kind of steps; None if it has to run kernel by kernel."""
        if not self._record:
            return None
        key, most = (kind, held.addresses), self._pairs.most
        recording = self._recordings.get(key)
        if recording is None and len(self._recordings) >= MAX_RECORDINGS:
            oldest = next(iter(self._recordings))
            if self._steps - self._used[oldest] < UNUSED:
                return None
            del self._recordings[oldest], self._used[oldest]
        if recording is None or most > recording.pairs:
            recording = self._recorded(state, held, inputs, settings, int(SPARE_PAIRS * most) + 1)
            self._recordings[key] = recording
        self._recordings.move_to_end(key)
        self._used[key] = self._steps
        return recording

    def _recorded(
        self, state: FieldState, held: _Held, inputs: StepInputs, settings: RenderSettings, pairs: int
    ) -> _Recording:
        device, own = state.device, inputs.clone()
        rates = torch.tensor(held.rates, device=device)

        def step() -> StepResult:
            capacity = Capacity(pairs)
            limited = replace(settings, backend=RecordableGsplat(capacity))
            return self._step(state, held, own, limited, rates, capacity)

        last = next(reversed(self._recordings.values()), None)
        # Results are read before the next replay, so all recordings can work in the same memory.
        graph, result = record(step, device, share_memory_with=None if last is None else last.graph)
        return _Recording(graph, own, rates, result, pairs)

    def _step(
        self,
        state: FieldState,
        held: _Held,
        inputs: StepInputs,
        settings: RenderSettings,
        rates: Tensor,
        capacity: Capacity | None,
    ) -> StepResult:
        """One step on the buffers; all of its work is recorded."""
        tensors, head, view = self._buffers.tensors, settings.head, inputs.view
        field = Field({name: tensors[name] for name in held.trained}, state.field.encoding)
        source = LocalField(_complete(field, state.field))
        loss, splatted, result = forward(source, state, field, self._losses, inputs, settings)
        network = [] if head is None else list(head.parameters())
        counting, centers = state.densifying and "grad2d" in tensors, splatted.info["means2d"]
        wanted = [*field.values(), *network, *([centers] if counting else [])]
        grads = torch.autograd.grad(loss, wanted, allow_unused=True)
        with torch.no_grad():
            overflow = self._pairs.overflow(capacity)
            if counting:
                of_centers, radii = centers.absgrad if settings.absgrad else grads[-1], splatted.info["radii"]
                radii = radii if overflow is None else radii * (overflow == 0)
                count_view(tensors, of_centers[0], radii[0], view.width, view.height)
            self._descend(held, dict(zip([*field.values(), *network], grads, strict=False)), rates, overflow)
        return result

    def _descend(
        self, held: _Held, grads: Mapping[Tensor, Tensor | None], rates: Tensor, overflow: Tensor | None
    ) -> None:
        """Adam, as ``torch.optim.Adam`` with ``fused`` does it, with rates in memory."""
        tensors, updates = self._buffers.tensors, []
        for name, optimizer, group in held.groups:
            parts = []
            for value in group["params"]:
                whole, own = tensors.get(name, value), optimizer.state[value]
                grad = grads.get(whole)
                if grad is None:
                    continue
                if grad.stride() != whole.stride():  # kernels walk through all tensors in the order of memory
                    grad = torch.empty_like(whole).copy_(grad)
                mean, square = (tensors.get(f"{name}.{moment}", own[moment]) for moment in MOMENTS)
                parts.append(_Update(whole, grad, mean, square, own["step"]))
            updates.append(parts)
        steps = [one.step for parts in updates for one in parts]
        torch._foreach_add_(steps, 1)
        for rate, parts, (_, _, group) in zip(rates, updates, held.groups, strict=True):
            if parts:
                _adam(parts, group, rate, overflow)
        if overflow is not None:
            torch._foreach_sub_(steps, [overflow] * len(steps))


class _Update(NamedTuple):
    """What Adam changes of one parameter, and its gradient."""

    value: Tensor
    grad: Tensor
    mean: Tensor
    square: Tensor
    step: Tensor


def _adam(parts: Sequence[_Update], group: Mapping[str, Any], rate: Tensor, overflow: Tensor | None) -> None:
    """Update the parameters of one group."""
    if len(parts) == 1 and parts[0].value.is_cuda and group["weight_decay"] == 0:
        adam(*parts[0], rate, overflow, betas=group["betas"], eps=group["eps"])
        return
    values, grads, means, squares, steps = ([part[column] for part in parts] for column in range(5))
    beta1, beta2 = group["betas"]
    update = torch._fused_adamw_ if group.get("decoupled_weight_decay") else torch._fused_adam_
    update(
        *(values, grads, means, squares, [], steps),
        lr=rate,
        beta1=beta1,
        beta2=beta2,
        weight_decay=group["weight_decay"],
        eps=group["eps"],
        amsgrad=False,
        maximize=False,
        found_inf=overflow,
    )


def _complete(field: Field, whole: Field) -> Field:
    """The trained parameters, and those without values, such as the features of a field without a head."""
    empty = {name: value for name, value in whole.items() if name not in field and value.numel() == 0}
    return Field({**empty, **field}, field.encoding)


def _kind(state: FieldState, inputs: StepInputs, settings: RenderSettings) -> Hashable:
    """What decides on the kernels of a step, beside numbers of primitives."""
    view, head = inputs.view, settings.head
    degree = degree_in_use(state.field.sh_degree, settings.active_sh_degree)
    return (
        (view.width, view.height, inputs.mask is not None, degree, settings.antialiased, settings.absgrad),
        (state.densifying, state.pruned, state.head_enabled),
        None if head is None else (head.net, *vars(head.config).values()),
    )
