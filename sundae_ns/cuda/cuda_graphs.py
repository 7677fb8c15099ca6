"""Recording and replay of GPU work as CUDA graphs, and a cache of recorded graphs."""

from __future__ import annotations

import gc
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Generic, TypeVar

import torch

from sundae_ns.core.errors import BackendError

MAX_GRAPHS = 4  # Graphs cached at a time: each holds its own images and activations
RECORD_AT = 3  # Requests in a row after which a key is recorded: a viewer that is being resized never repeats a size

_Result = TypeVar("_Result")

_abandoned: list[torch.cuda.CUDAGraph] = []  # unfinished graphs, kept alive because torch may still refer to them
_thread = threading.local()
_one_at_a_time = threading.Lock()


@contextmanager
def warm_up(device: torch.device) -> Iterator[None]:
    """Context to run work once before it is recorded: it allocates and selects kernels, which cannot be recorded."""
    side = _side_stream(device)
    side.wait_stream(torch.cuda.current_stream(device))
    try:
        with torch.cuda.stream(side):
            yield
    finally:
        torch.cuda.current_stream(device).wait_stream(side)


def _side_stream(device: torch.device) -> torch.cuda.Stream:
    # One for all graphs, because memory cached for one stream does not serve another; one per thread, because work of
    # another thread would be recorded too.
    streams: dict[torch.device, torch.cuda.Stream] = _thread.__dict__.setdefault("streams", {})
    if device not in streams:
        streams[device] = torch.cuda.Stream(device)
    return streams[device]


def record(
    run: Callable[[], _Result], device: torch.device, share_memory_with: torch.cuda.CUDAGraph | None = None
) -> tuple[torch.cuda.CUDAGraph, _Result]:
    """Record the GPU work of ``run`` without executing it: the graph, and tensors that each replay writes.

    ``run`` has run before (:func:`warm_up`), does not wait for the GPU, and reads only memory that stays in place.
    Graphs that share memory must be replayed in their order. ``BackendError`` if the work cannot be recorded; nothing
    was executed then, and later work is not affected.
    """
    graph = torch.cuda.CUDAGraph()
    # A training loop beside a viewer may allocate meanwhile: record this thread's work only.
    pool = torch.cuda.graph_pool_handle() if share_memory_with is None else share_memory_with.pool()
    # Name the stream: torch's own belongs to the device that was current at its first recording.
    side = _side_stream(device)
    errors: list[RuntimeError] = []
    with _one_at_a_time, torch.cuda.device(device), ExitStack() as stack:
        if gc.isenabled():  # collecting an earlier graph would break the recording
            gc.disable()
            stack.callback(gc.enable)
        generator = torch.cuda.default_generators[torch.cuda.current_device()]
        before = generator.clone_state()
        try:
            # After a failed recording torch stays on its stream, and later work would not be ordered with gsplat's.
            with torch.cuda.stream(side):
                with torch.cuda.graph(graph, pool=pool, stream=side, capture_error_mode="thread_local"):
                    try:
                        result = run()
                    except RuntimeError as error:
                        errors.append(error)
                        raise
        except RuntimeError as error:
            if error not in errors:  # ending the recording failed too
                errors.append(error)
                # Else torch's allocator would ask this graph for its allocations, and never release memory. There is no
                # public function.
                with suppress(AttributeError, RuntimeError):
                    torch._C._cuda_endAllocateToPool(torch.cuda.current_device(), pool)
                _abandoned.append(graph)
                # Else torch refuses random numbers: its generator waits for a recording that does not exist.
                generator.graphsafe_set_state(before)
            first = errors[0]
            if isinstance(first, torch.cuda.OutOfMemoryError):
                raise first from None
            cause = str(first).partition("\n")[0]
            raise BackendError(f"{device} cannot record this as a CUDA graph: {cause}") from first
    return graph, result


class GraphCache(Generic[_Result]):
    """Recorded graphs by key: the least recently used one is dropped."""

    def __init__(self) -> None:
        self._graphs: OrderedDict[Hashable, _Result] = OrderedDict()
        self._last: Hashable = None
        self._repeats = 0

    def get(self, key: Hashable, make: Callable[[], _Result]) -> _Result | None:
        """The graph for ``key``, recorded by ``make`` at its :data:`RECORD_AT`-th request in a row; None before."""
        self._repeats = self._repeats + 1 if key == self._last else 1
        self._last = key
        if key not in self._graphs:
            if self._repeats < RECORD_AT:
                return None
            if len(self._graphs) >= MAX_GRAPHS:
                self._graphs.popitem(last=False)
            self._graphs[key] = make()
        self._graphs.move_to_end(key)
        return self._graphs[key]

    def put(self, key: Hashable, graph: _Result) -> None:
        """Replace the graph of a cached key."""
        self._graphs[key] = graph

    def clear(self) -> None:
        """Drop all graphs, and forget the last key."""
        self._graphs.clear()
        self._last, self._repeats = None, 0
