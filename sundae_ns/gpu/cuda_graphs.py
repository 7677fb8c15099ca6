"""Work of a GPU that is recorded once and played back: CUDA graphs, and which of them are kept. Floor 0."""

from __future__ import annotations

import gc
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager, suppress
from typing import Generic, TypeVar

import torch

from sundae_ns.errors import BackendError

MAX_SIZES = 4
"""Recordings kept at a time: each holds its own pictures and activations."""

RECORD_AT = 3
"""What comes for this time in a row is recorded: a viewer that is being resized never shows one size twice."""

Result = TypeVar("Result")

_failed: list[torch.cuda.CUDAGraph] = []
"""Recordings that were not finished, kept for what torch may still ask them."""

_thread = threading.local()
_one_at_a_time = threading.Lock()


@contextmanager
def aside(device: torch.device) -> Iterator[None]:
    """Run once what is going to be recorded: it allocates and chooses kernels, neither of which can be recorded."""
    side = _side_stream(device)
    side.wait_stream(torch.cuda.current_stream(device))
    try:
        with torch.cuda.stream(side), _recording():
            yield
    finally:
        torch.cuda.current_stream(device).wait_stream(side)


def recording() -> bool:
    """Whether this thread is about to record something, or does: what it calls meanwhile is to make no recording of its own."""
    return getattr(_thread, "recording", False)


@contextmanager
def _recording() -> Iterator[None]:
    before, _thread.recording = recording(), True
    try:
        yield
    finally:
        _thread.recording = before


@contextmanager
def _uncollected() -> Iterator[None]:
    """Python collects no garbage meanwhile: a graph among it would be destroyed, and what is being recorded with it."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


def _side_stream(device: torch.device) -> torch.cuda.Stream:
    # One for all recordings, because memory that torch keeps for one stream does not serve another; of each thread, because
    # what another one does on a stream would be recorded with it.
    streams: dict[torch.device, torch.cuda.Stream] = _thread.__dict__.setdefault("streams", {})
    if device not in streams:
        streams[device] = torch.cuda.Stream(device)
    return streams[device]


def record(
    run: Callable[[], Result], device: torch.device, shares: torch.cuda.CUDAGraph | None = None
) -> tuple[torch.cuda.CUDAGraph, Result]:
    """Record what ``run`` does, without doing it.

    Args:
        run: must have run before (:func:`aside`), wait for nothing, and read only what stays where it is.
        device: where it runs.
        shares: a graph whose memory this one uses too; they are played in this order.

    Returns:
        The graph, and what ``run`` returned: tensors that the graph writes whenever it is played.

    Raises:
        BackendError: it cannot be recorded. Nothing was done then, and what is done next is done as before.
        torch.cuda.OutOfMemoryError: there is no room for what it makes.
    """
    graph = torch.cuda.CUDAGraph()
    # A training loop beside a viewer may allocate meanwhile; only this thread's work belongs to the recording.
    pool = torch.cuda.graph_pool_handle() if shares is None else shares.pool()
    # On a stream of this device: torch's own belongs to whichever device was the current one at its first recording.
    side = _side_stream(device)
    errors: list[RuntimeError] = []
    with _one_at_a_time, torch.cuda.device(device), _recording(), _uncollected():
        generator = torch.cuda.default_generators[torch.cuda.current_device()]
        before = generator.clone_state() if hasattr(generator, "clone_state") else None  # not in torch 2.1
        try:
            # Torch does not leave the stream of a recording that fails; all later work would go there, unordered with gsplat's.
            with torch.cuda.stream(side):
                with torch.cuda.graph(graph, pool=pool, stream=side, capture_error_mode="thread_local"):
                    try:
                        result = run()
                    except RuntimeError as error:
                        errors.append(error)
                        raise
        except RuntimeError as error:
            if error not in errors:  # it was not ended either
                errors.append(error)
                _abandon(graph, pool)
                if before is not None:
                    # Or random numbers would be refused, as of a recording that is not there.
                    generator.graphsafe_set_state(before)
            first = errors[0]
            if isinstance(first, torch.cuda.OutOfMemoryError):
                raise first from None
            cause = str(first).partition("\n")[0]
            raise BackendError(f"{device} cannot record this as a CUDA graph: {cause}") from first
    return graph, result


def _abandon(graph: torch.cuda.CUDAGraph, pool: tuple[int, int]) -> None:
    """Tell torch's allocator that a recording is over which could not be ended: it would give no memory back."""
    # Torch has no public way; where this one is missing, it goes on asking the graph whether an allocation is its own.
    with suppress(AttributeError, RuntimeError):
        torch._C._cuda_endAllocateToPool(torch.cuda.current_device(), pool)
    _failed.append(graph)


class Kept(Generic[Result]):
    """Recordings, by what tells them apart: a few of those that were used last."""

    def __init__(self) -> None:
        self._kept: OrderedDict[Hashable, Result] = OrderedDict()
        self._last: Hashable = None
        self._in_a_row = 0

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, key: Hashable, make: Callable[[], Result]) -> Result | None:
        """The recording for ``key``, made when it is asked for often enough in a row; None before."""
        self._in_a_row = self._in_a_row + 1 if key == self._last else 1
        self._last = key
        if key not in self._kept:
            if self._in_a_row < RECORD_AT:
                return None
            if len(self._kept) >= MAX_SIZES:
                self._kept.popitem(last=False)
            self._kept[key] = make()
        self._kept.move_to_end(key)
        return self._kept[key]

    def put(self, key: Hashable, recording: Result) -> None:
        """Keep another recording for a key that there is one for."""
        self._kept[key] = recording

    def clear(self) -> None:
        """Forget all, and what came last."""
        self._kept.clear()
        self._last, self._in_a_row = None, 0
