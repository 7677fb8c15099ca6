"""Whole training steps as CUDA graphs: the step, gradients, statistics of densification, and Adam.

A step is some two hundred small kernels. Launched one by one from Python they take several times as long as the GPU
works. A graph launches them together. It reads and writes fixed addresses and a fixed number of Gaussians, so the
field lies in buffers with memory for more.
"""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping, MutableMapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from sundae_ns.core.errors import BackendError, MemoryExhaustedError, one_line
from sundae_ns.core.gaussians import FEATURES, Gaussians
from sundae_ns.cuda.adam import Update, adam_step
from sundae_ns.cuda.cuda_graphs import record, warm_up
from sundae_ns.rasterize.gsplat_backend import RecordableGsplat
from sundae_ns.rasterize.gsplat_kernels import Capacity
from sundae_ns.scene.render import GaussianSource, RenderSettings
from sundae_ns.train.densification import COUNTED, STATISTICS, count_view, start_counting
from sundae_ns.train.state import HEAD, TrainingState
from sundae_ns.train.step import StepInputs, StepLosses, StepResult, training_step

_log = logging.getLogger(__name__)

SPARE = 1.1  # Capacity for a field that grows, as a multiple of its number of Gaussians
MOMENTS = ("exp_avg", "exp_avg_sq")  # Adam's moments in the state of its optimizer
_UNSEEN = {"means": 1e15, "scales": -30.0, "opacities": -30.0}
"""Values of the rows beyond: behind the far plane, without width, transparent. Others are zero."""


class Buffers:
    """Tensors of the Gaussians at a capacity."""

    def __init__(self) -> None:
        self.tensors: dict[str, Tensor] = {}  # By name of the row, [capacity, ...]
        self.capacity = 0
        self._num_rows = 0

    def hold(self, state: TrainingState, trained: tuple[str, ...], *, growing: bool) -> bool:
        """Let the tensors of a state be the first rows of the buffers; those replaced since the last call are copied.

        The optimizers have states for the parameters ``trained``. Buffers of ``growing`` Gaussians have spare rows.
        Returns whether the buffers are new, so that work on the older ones is void.
        """
        n, rows = state.gaussians.num_gaussians, list(_rows(state, trained))
        shapes = {name: mapping[key].shape[1:] for name, mapping, key in rows}
        fits = n <= self.capacity <= 2 * n if growing else n == self.capacity
        # Trials widen and narrow features.
        renewed = not fits or shapes != {name: buffer.shape[1:] for name, buffer in self.tensors.items()}
        if renewed:
            self.capacity = int(SPARE * n) if growing else n
            for name in self.tensors.keys() - shapes.keys():
                del self.tensors[name]
        for name, mapping, key in rows:
            value, buffer = mapping[key], self.tensors.get(name)
            if renewed or buffer is None:
                # One at a time: each replaces the older memory before the next is made.
                buffer = value.detach().new_empty(self.capacity, *value.shape[1:]).requires_grad_(value.requires_grad)
                self.tensors[name] = buffer
            elif value.data_ptr() == buffer.data_ptr() and n == self._num_rows:
                continue
            with torch.no_grad():
                buffer[:n].copy_(value)
                buffer[n:].fill_(_UNSEEN.get(name, 0.0))
            if isinstance(value, torch.nn.Parameter):  # stays the same object
                value.data = buffer.detach()[:n]
            else:
                mapping[key] = buffer.detach()[:n]
        self._num_rows = n
        return renewed


def start_moments(state: TrainingState, trained: tuple[str, ...]) -> None:
    """Make the state of Adam for parameters that have none, as its first step would."""
    for optimizer in (state.optimizers[name] for name in trained):
        for value in (value for group in optimizer.param_groups for value in group["params"]):
            if not (moments := optimizer.state[value]):
                moments["step"] = torch.zeros((), dtype=torch.float32, device=value.device)
                moments.update({name: torch.zeros_like(value) for name in MOMENTS})


def trained_parameters(state: TrainingState) -> tuple[str, ...]:
    """Names of the parameters of the field that a step trains: features are trained with the head only."""
    used = (name for name in state.gaussians if name != FEATURES or state.head_enabled)
    return tuple(name for name in used if state.gaussians[name].numel() > 0)


def _rows(state: TrainingState, trained: tuple[str, ...]) -> Iterator[tuple[str, MutableMapping[Any, Any], Any]]:
    """Name, mapping and key of each tensor with a row for each Gaussian; moments are NAME.exp_avg and the like."""
    gaussians: Any = state.gaussians
    for name in trained:
        yield name, gaussians, name
        yield from ((f"{name}.{moment}", state.optimizers[name].state[gaussians[name]], moment) for moment in MOMENTS)
    if state.densifying:
        running = state.densification
        yield from ((name, running, name) for name in STATISTICS if running.get(name) is not None)


SPARE_PAIRS = 1.5  # Capacity for tile/Gaussian pairs, as a multiple of the most that a view has needed
MAX_RECORDINGS = 16  # Recordings kept at a time: two for each image size and SH degree in use
UNUSED = 1000
"""Steps after which an unused recording makes room. Where more sizes are in use than fit, the others run kernel by
kernel, because recording takes longer than a step."""
StepWork = Callable[[StepInputs, RenderSettings, Capacity | None], StepResult]
"""The GPU work of a step, with the capacity of the rasteriser that is set; None for another rasteriser."""


@dataclass(frozen=True)
class _Recording:
    graph: torch.cuda.CUDAGraph
    inputs: StepInputs  # The graph reads them here
    result: StepResult  # The graph writes it here
    pairs: int  # Tile/Gaussian pairs that fit


class StepRecordings:
    """Runs training steps. The first of a kind runs kernel by kernel, because libraries choose and load kernels then.

    Later ones replay. A step whose image has more tile/Gaussian pairs than fit changes nothing, and the next recording
    has a larger capacity. Without ``record`` every step runs kernel by kernel, as a test does on a CPU.
    """

    def __init__(self, *, record: bool = True) -> None:
        self._record, self._failed = record, False
        self._recordings: OrderedDict[Hashable, _Recording] = OrderedDict()
        self._used: dict[Hashable, int] = {}  # Step at which a recording was last replayed
        self._steps = 0
        self._warm: set[Hashable] = set()  # Kinds of steps that have run kernel by kernel
        self._most: Tensor | None = None  # Most tile/Gaussian pairs that a view has needed, on the device, int64 []
        self._most_on_host: Tensor | None = None  # Its pinned copy, some steps late

    def forget(self, *, pairs: bool = False) -> None:
        """Drop all recordings; with ``pairs`` also measure again how many pairs a view needs."""
        self._recordings.clear()
        self._used.clear()
        if pairs:
            self._warm.clear()

    def run(
        self, work: StepWork, inputs: StepInputs, settings: RenderSettings, kind: Hashable, addresses: Hashable = None
    ) -> StepResult | None:
        """Run a step, by its recording if there is one; None if steps cannot be recorded, and nothing has changed.

        ``kind`` decides on the kernels of the step; ``addresses`` are of what a recording reads beside its inputs,
        where they may change. The backend of ``settings`` is gsplat for recording.
        """
        if self._failed:
            return None
        try:
            recording = self._recording(work, inputs, settings, kind, addresses) if kind in self._warm else None
            if recording is None:
                result = self._kernel_by_kernel(work, inputs, settings)
                self._warm.add(kind)
            else:
                inputs.copy_to(recording.inputs)
                recording.graph.replay()
                result = recording.result
        except (BackendError, MemoryExhaustedError, torch.cuda.OutOfMemoryError) as error:
            _log.warning("training continues without recordings, slower: %s", one_line(error))
            self._failed = True
            self.forget()
            torch.cuda.empty_cache()
            return None
        self._steps += 1
        return result

    @torch.no_grad()
    def overflow(self, capacity: Capacity | None) -> Tensor | None:
        """1 if the lists of tiles were too short, so the step must change nothing; else 0, float ``[]``."""
        if capacity is None or capacity.pairs is None:  # lists of any length
            return None
        assert self._most is not None
        assert self._most_on_host is not None
        needed = torch.stack(capacity.needed).amax()
        torch.maximum(self._most, needed, out=self._most)
        self._most_on_host.copy_(self._most, non_blocking=True)
        return (needed > capacity.pairs).float()

    def _kernel_by_kernel(self, work: StepWork, inputs: StepInputs, settings: RenderSettings) -> StepResult:
        """Run a step on the stream of the recordings, and count its pairs, which waits for the GPU."""
        if (device := inputs.target.device).type != "cuda":
            return work(inputs, settings, None)
        capacity = Capacity()
        with warm_up(device):
            result = work(inputs, replace(settings, backend=RecordableGsplat(capacity)), capacity)
        most = max(int(number) for number in capacity.needed)
        if self._most is None or self._most_on_host is None:
            self._most = torch.zeros((), dtype=torch.int64, device=device)
            self._most_on_host = torch.zeros((), dtype=torch.int64, pin_memory=True)
        if self._warm:  # else forget the steps before
            most = max(most, int(self._most))
        self._most.fill_(most)
        self._most_on_host.fill_(most)
        return result

    def _recording(
        self, work: StepWork, inputs: StepInputs, settings: RenderSettings, kind: Hashable, addresses: Hashable
    ) -> _Recording | None:
        """The recording of a kind of steps; None if it has to run kernel by kernel."""
        if not self._record or self._most_on_host is None:
            return None
        key = kind, addresses
        most = int(self._most_on_host)
        if (recording := self._recordings.get(key)) is None and len(self._recordings) >= MAX_RECORDINGS:
            oldest = next(iter(self._recordings))
            if self._steps - self._used[oldest] < UNUSED:
                return None
            del self._recordings[oldest], self._used[oldest]
        if recording is None or most > recording.pairs:
            recording = self._recorded(work, inputs, settings, int(SPARE_PAIRS * most) + 1)
            self._recordings[key] = recording
        self._recordings.move_to_end(key)
        self._used[key] = self._steps
        return recording

    def _recorded(self, work: StepWork, inputs: StepInputs, settings: RenderSettings, pairs: int) -> _Recording:
        copied = inputs.clone()

        def step() -> StepResult:
            capacity = Capacity(pairs)
            return work(copied, replace(settings, backend=RecordableGsplat(capacity)), capacity)

        last = next(reversed(self._recordings.values()), None)
        # Results are read before the next replay, so all recordings can work in the same memory.
        graph, result = record(step, copied.target.device, share_memory_with=None if last is None else last.graph)
        return _Recording(graph, copied, result, pairs)


@dataclass(frozen=True)
class _Held:
    """The tensors of a state whose Gaussians lie in the buffers, to notice cheaply when one is replaced."""

    trained: tuple[str, ...]  # Names of the parameters of the Gaussians that are trained
    growing: bool  # Whether the buffers have spare rows
    groups: list[tuple[str, torch.optim.Optimizer, dict[str, Any]]]  # Name, optimizer, group
    tensors: list[tuple[Mapping[Any, Any], Any, Any]]  # What surgery and snapshots replace: mapping, key, value
    addresses: Hashable  # What a recording reads beside the buffers: the head's weights, and the counts of steps

    def unchanged(self, state: TrainingState, settings: RenderSettings) -> bool:
        """Whether the state still consists of these tensors."""
        with_head = self.groups[-1][0] == HEAD
        return (
            self.growing == state.densifying
            and with_head == (settings.head is not None)
            and all(mapping.get(key) is value for mapping, key, value in self.tensors)
            and self.trained == trained_parameters(state)
        )


class RecordedStep:
    """Training steps of one set of Gaussians; without ``record`` kernel by kernel, as a test does on a CPU."""

    def __init__(self, losses: StepLosses, *, record: bool = True) -> None:
        self._losses, self._buffers = losses, Buffers()
        self._held: _Held | None = None
        self._recordings = StepRecordings(record=record)

    def __call__(self, state: TrainingState, inputs: StepInputs, settings: RenderSettings) -> StepResult | None:
        """Train one step; None if steps cannot be recorded, and nothing has changed.

        Afterwards the tensors of ``state`` are rows of this object's buffers, and ``info`` says that the statistics of
        densification are counted. Learning rates are those of the optimizers; the backend of ``settings`` is gsplat.
        """
        if (held := self._held) is None or not held.unchanged(state, settings):
            held = self._held = self._hold(state, settings)
        values = [float(group["lr"]) for _, _, group in held.groups]
        # Pinned: copying from other memory would wait until the GPU has finished the last step.
        pinned = torch.tensor(values, dtype=torch.float32, pin_memory=state.device.type == "cuda")
        kind = _kind(state, inputs, settings)
        inputs = replace(inputs, rates=pinned.to(state.device, non_blocking=True))
        result = self._recordings.run(partial(self._step, state, held), inputs, settings, kind, held.addresses)
        if result is not None:
            state.info = {COUNTED: True}
        return result

    def _hold(self, state: TrainingState, settings: RenderSettings) -> _Held:
        """Let the Gaussians be rows of the buffers, with all states that their optimizers need."""
        trained, head = trained_parameters(state), settings.head
        names = trained if head is None else (*trained, HEAD)
        start_moments(state, names)
        if state.densifying:
            start_counting(state.densification, state.gaussians["means"])
        if self._buffers.hold(state, trained, growing=state.densifying):
            self._recordings.forget(pairs=not state.densifying)  # after a prune a view needs far fewer pairs
        optimizers = [(name, state.optimizers[name]) for name in names]
        groups = [(name, optimizer, group) for name, optimizer in optimizers for group in optimizer.param_groups]
        moments = [(optimizer.state, value) for _, optimizer, group in groups for value in group["params"]]
        tensors: list[tuple[Mapping[Any, Any], Any, Any]] = [(mapping, key, mapping[key]) for mapping, key in moments]
        addresses = tuple(adam[name].data_ptr() for _, _, adam in tensors for name in (*MOMENTS, "step"))
        tensors += [(state.gaussians, name, state.gaussians[name]) for name in trained]
        running = state.densification
        tensors += [(running, name, value) for name, value in running.items() if isinstance(value, Tensor)]
        of_head = None if head is None else head.addresses()
        return _Held(trained, state.densifying, groups, tensors, (addresses, of_head))

    def _step(
        self, state: TrainingState, held: _Held, inputs: StepInputs, settings: RenderSettings, capacity: Capacity | None
    ) -> StepResult:
        """One step on the buffers; all of its work is recorded."""
        tensors = self._buffers.tensors
        trained = {name: tensors[name] for name in held.trained}
        # With parameters that have no values, such as the features of a field without a head.
        empty = {name: value for name, value in state.gaussians.items() if name not in trained and value.numel() == 0}
        source = GaussianSource(Gaussians({**empty, **trained}, state.gaussians.encoding))
        loss, splatted, result = training_step(source, state, self._losses, inputs, settings)
        network = [] if settings.head is None else list(settings.head.parameters())
        counting = state.densifying and "grad2d" in tensors
        centers = splatted.info["means2d"]
        wanted = [*trained.values(), *network, *([centers] if counting else [])]
        grads = torch.autograd.grad(loss, wanted, allow_unused=True)
        with torch.no_grad():
            overflow = self._recordings.overflow(capacity)
            if counting:
                of_centers = centers.absgrad if settings.absgrad else grads[-1]
                radii = splatted.info["radii"] if overflow is None else splatted.info["radii"] * (overflow == 0)
                count_view(tensors, of_centers[0], radii[0], inputs.camera.width, inputs.camera.height)
            assert inputs.rates is not None
            updates = self._updates(held, dict(zip([*trained.values(), *network], grads, strict=False)))
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
                buffer, moments = tensors.get(name, value), optimizer.state[value]
                if (grad := grads.get(buffer)) is None:
                    continue
                if grad.stride() != buffer.stride():  # kernels walk through all tensors in the order of memory
                    grad = torch.empty_like(buffer).copy_(grad)
                mean, square = (tensors.get(f"{name}.{moment}", moments[moment]) for moment in MOMENTS)
                updates.append(Update(buffer, grad, mean, square, moments["step"]))
            groups.append((group, updates))
        return groups


def _kind(state: TrainingState, inputs: StepInputs, settings: RenderSettings) -> Hashable:
    """What decides on the kernels of a step, beside numbers of Gaussians."""
    camera, head = inputs.camera, settings.head
    degree = min(state.gaussians.sh_degree, settings.active_sh_degree)
    return (
        (camera.width, camera.height, inputs.mask is not None, degree, settings.antialiased, settings.absgrad),
        (state.densifying, state.pruned, state.head_enabled, settings.fixed_harmonics, settings.drop_rate),
        None if head is None else (head.net, *vars(head.config).values()),
    )
