"""Training steps as CUDA graphs: when to record one, and which to replay.

A step is some two hundred small kernels. Launched one by one from Python they take several times as long as the GPU
works. A graph launches them together. It reads its inputs where the last call has put them.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sundae_ns.gpu.cuda_graphs import record, warm_up
from sundae_ns.rasterization import Capacity, RecordableGsplat
from sundae_ns.rendering.render import RenderSettings
from sundae_ns.training.step import StepInputs, StepResult

SPARE_PAIRS = 2.0
"""Capacity for tile/primitive pairs, as a multiple of the most that a view has needed."""

MAX_RECORDINGS = 8
"""Recordings kept at a time: one for each image size and SH degree in use."""

UNUSED = 1000
"""Steps after which an unused recording makes room. Where more sizes are in use than fit, the others run kernel by
kernel, because recording takes longer than a step."""

StepWork = Callable[[StepInputs, RenderSettings, Capacity | None], StepResult]
"""The GPU work of a step, with the capacity of the rasteriser that is set; None for another rasteriser."""


@dataclass(frozen=True)
class _Recording:
    graph: torch.cuda.CUDAGraph
    inputs: StepInputs
    """The graph reads them here."""
    result: StepResult
    """The graph writes it here."""
    pairs: int
    """Tile/primitive pairs that fit."""


class StepRecordings:
    """Runs training steps. The first of a kind runs kernel by kernel, because libraries choose and load kernels then.

    Later ones replay. A step whose view has more tile/primitive pairs than fit changes nothing, and the next recording
    has room for them.

    Args:
        record: False runs every step kernel by kernel, as a test does on a CPU.
    """

    def __init__(self, *, record: bool = True) -> None:
        self._record = record
        self._recordings: OrderedDict[Hashable, _Recording] = OrderedDict()
        self._used: dict[Hashable, int] = {}
        """Step at which a recording was last replayed."""
        self._steps = 0
        self._warm: set[Hashable] = set()
        """Kinds of steps that have run kernel by kernel."""
        self._most: Tensor | None = None
        """Most tile/primitive pairs that a view has needed, on the device, int64 ``[]``."""
        self._most_on_host: Tensor | None = None
        """Its pinned copy, some steps late."""

    def forget(self, *, pairs: bool = False) -> None:
        """Drop all recordings; with ``pairs`` also measure again how many pairs a view needs."""
        self._recordings.clear()
        self._used.clear()
        if pairs:
            self._warm.clear()

    def run(
        self, work: StepWork, inputs: StepInputs, settings: RenderSettings, kind: Hashable, addresses: Hashable = None
    ) -> StepResult:
        """Run a step, by a recording where there is one.

        Args:
            work: of the step.
            inputs: of this step.
            settings: of training images, with the backend gsplat for recording.
            kind: decides on the kernels of the step.
            addresses: of what a recording reads beside its inputs, where they may change.

        Raises:
            BackendError: the step cannot be recorded. Nothing has changed.
            torch.cuda.OutOfMemoryError: the same.
        """
        recording = self._recording(work, inputs, settings, kind, addresses) if kind in self._warm else None
        if recording is None:
            result = self._kernel_by_kernel(work, inputs, settings)
            self._warm.add(kind)
        else:
            inputs.copy_to(recording.inputs)
            recording.graph.replay()
            result = recording.result
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

    def _count(self, capacity: Capacity, device: torch.device) -> None:
        """Count the pairs of a step that ran kernel by kernel, which waits for the GPU."""
        most = max(int(number) for number in capacity.needed)
        if self._most is None or self._most_on_host is None:
            self._most = torch.zeros((), dtype=torch.int64, device=device)
            self._most_on_host = torch.zeros((), dtype=torch.int64, pin_memory=True)
        if self._warm:  # else forget the steps before
            most = max(most, int(self._most))
        self._most.fill_(most)
        self._most_on_host.fill_(most)

    def _kernel_by_kernel(self, work: StepWork, inputs: StepInputs, settings: RenderSettings) -> StepResult:
        """Run a step on the stream of the recordings."""
        device = inputs.target.device
        if device.type != "cuda":
            return work(inputs, settings, None)
        capacity = Capacity()
        with warm_up(device):
            result = work(inputs, replace(settings, backend=RecordableGsplat(capacity)), capacity)
        self._count(capacity, device)
        return result

    def _recording(
        self, work: StepWork, inputs: StepInputs, settings: RenderSettings, kind: Hashable, addresses: Hashable
    ) -> _Recording | None:
        """The recording of a kind of steps; None if it has to run kernel by kernel."""
        if not self._record:
            return None
        assert self._most_on_host is not None
        key, most = (kind, addresses), int(self._most_on_host)
        recording = self._recordings.get(key)
        if recording is None and len(self._recordings) >= MAX_RECORDINGS:
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
        own = inputs.clone()

        def step() -> StepResult:
            capacity = Capacity(pairs)
            return work(own, replace(settings, backend=RecordableGsplat(capacity)), capacity)

        last = next(reversed(self._recordings.values()), None)
        # Results are read before the next replay, so all recordings can work in the same memory.
        graph, result = record(step, own.target.device, share_memory_with=None if last is None else last.graph)
        return _Recording(graph, own, result, pairs)
