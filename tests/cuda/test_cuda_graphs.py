"""The cache of CUDA graphs, and the recording of one; users of recorded graphs have tests of their own."""

import gc
from contextlib import contextmanager, nullcontext
from functools import partial
from unittest import mock

import pytest
import torch

from sundae_ns.core.errors import BackendError
from sundae_ns.cuda import cuda_graphs
from sundae_ns.cuda.cuda_graphs import MAX_GRAPHS, RECORD_AT, GraphCache, record, warm_up


def test_a_key_repeated_in_a_row_is_recorded_once():
    cache = GraphCache()
    made = []

    def get(key):
        return cache.get(key, lambda: made.append(key) or f"graph of {key}")

    for key in "abababab":
        assert get(key) is None
    assert [get("a") for _ in range(RECORD_AT + 2)] == [None] * (RECORD_AT - 1) + ["graph of a"] * 3
    assert get("b") is None
    assert get("a") == "graph of a"
    assert made == ["a"]


def test_the_least_recently_used_graph_is_dropped():
    cache = GraphCache()
    for key in range(MAX_GRAPHS):
        for _ in range(RECORD_AT):
            cache.get(key, lambda key=key: key)
    cache.get(0, lambda: -1)
    for _ in range(RECORD_AT):
        cache.get(MAX_GRAPHS, lambda: MAX_GRAPHS)
    assert len(cache._graphs) == MAX_GRAPHS
    assert cache.get(0, lambda: -1) == 0
    assert cache.get(1, lambda: -1) is None
    cache.put(0, 7)
    assert cache.get(0, lambda: -1) == 7
    cache.clear()
    assert len(cache._graphs) == 0
    assert cache.get(0, lambda: -1) is None  # the count of repeats starts anew


def test_a_failed_recording_restores_stream_generator_and_garbage_collection(monkeypatch, request):
    streams, generator, ended, failed = ["main"], mock.Mock(), mock.Mock(), []

    @contextmanager
    def stream(side):
        before = streams[:]
        streams.append(side)
        try:
            yield
        finally:
            streams[:] = before

    @contextmanager
    def capture(graph, *, stream, **_):
        """Like torch's: a failure at its end leaves its stream current."""
        streams.append(stream)
        try:
            yield
        finally:
            assert not gc.isenabled()
            raise RuntimeError("operation failed due to a previous error during capture\nand more lines")

    stand_ins = {"stream": stream, "graph": capture, "CUDAGraph": object, "device": nullcontext}
    stand_ins |= {"default_generators": (generator,), "current_device": lambda: 0, "graph_pool_handle": lambda: "pool"}
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(torch.cuda, name, stand_in)
    monkeypatch.setattr(cuda_graphs, "_side_stream", lambda device: "side")
    monkeypatch.setattr(cuda_graphs, "_abandoned", failed)
    monkeypatch.setattr(torch._C, "_cuda_endAllocateToPool", ended, raising=False)
    with pytest.raises(BackendError, match="as a CUDA graph: operation failed .* during capture$"):
        record(lambda: streams, torch.device("cuda"))
    assert streams == ["main"]
    generator.graphsafe_set_state.assert_called_once_with(generator.clone_state())
    ended.assert_called_once_with(0, "pool")
    assert len(failed) == 1
    assert gc.isenabled()
    request.addfinalizer(gc.enable)
    gc.disable()
    too_much = mock.Mock(side_effect=torch.cuda.OutOfMemoryError("no room"))
    with pytest.raises(torch.cuda.OutOfMemoryError, match="no room"):  # not the error that follows from it
        record(too_much, torch.device("cuda"))
    assert ended.call_count == len(failed) == 2
    assert not gc.isenabled()


@pytest.mark.gpu
def test_a_graph_in_the_garbage_does_not_break_a_recording(request):
    request.addfinalizer(partial(gc.set_threshold, *gc.get_threshold()))
    gc.set_threshold(1, 1, 1)  # collect at almost every allocation
    device, values = torch.device("cuda"), torch.arange(8.0, device="cuda")

    def plus(summand):
        return values + summand

    with warm_up(device):
        plus(1.0)
    others = [record(lambda: plus(1.0), device)]

    def run():
        ring = [others.pop()]
        ring.append(ring)
        del ring
        assert len([[] for _ in range(1000)]) == 1000  # allocations that trigger the collector
        return plus(2.0)

    graph, made = record(run, device)
    graph.replay()
    assert torch.equal(made, values + 2)


@pytest.mark.gpu
def test_later_work_is_not_affected_by_a_failed_recording():
    device, values = torch.device("cuda"), torch.arange(8.0, device="cuda")
    before = torch.cuda.current_stream()

    def total():
        return (values + 1).sum()

    with warm_up(device):
        total()
    for _ in range(3):
        with pytest.raises(BackendError, match="cannot record this as a CUDA graph"):
            record(lambda: float(total()), device)  # waits for the device
        assert torch.cuda.current_stream() == before
        torch.manual_seed(1)
        drawn = torch.rand(3, device="cuda")
        large = torch.empty(2**28, device="cuda")
        held = torch.cuda.memory_reserved()
        del large
        torch.cuda.empty_cache()
        assert torch.cuda.memory_reserved() <= held - 2**30, "the allocator releases free memory"
        torch.manual_seed(1)
        assert torch.equal(drawn, torch.rand(3, device="cuda"))
    graph, made = record(total, device)
    values += 1
    graph.replay()
    assert float(made) == float(total())
    assert torch.cuda.current_stream() == before
