"""Which recordings are kept; what a GPU records is tested where it is used."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from sundae_ns import cuda_graphs
from sundae_ns.cuda_graphs import MAX_SIZES, RECORD_AT, Kept, recording


def test_what_comes_often_enough_in_a_row_is_recorded_once() -> None:
    kept: Kept[str] = Kept()
    made: list[str] = []

    def get(key: str) -> str | None:
        return kept.get(key, lambda: made.append(key) or f"graph of {key}")

    for key in "abababab":
        assert get(key) is None
    found = [get("a") for _ in range(RECORD_AT + 2)]
    assert found == [None] * (RECORD_AT - 1) + ["graph of a"] * 3
    assert get("b") is None
    assert get("a") == "graph of a"
    assert made == ["a"]


def test_the_one_that_was_used_longest_ago_is_forgotten() -> None:
    kept: Kept[int] = Kept()
    for key in range(MAX_SIZES):
        for _ in range(RECORD_AT):
            kept.get(key, lambda key=key: key)
    kept.get(0, lambda: -1)
    for _ in range(RECORD_AT):
        kept.get(MAX_SIZES, lambda: MAX_SIZES)
    assert len(kept) == MAX_SIZES
    assert kept.get(0, lambda: -1) == 0
    assert kept.get(1, lambda: -1) is None
    kept.put(0, 7)
    assert kept.get(0, lambda: -1) == 7
    kept.clear()
    assert len(kept) == 0
    assert kept.get(0, lambda: -1) is None  # what came last is forgotten too: it is the first time again


def test_a_recording_keeps_what_it_calls_from_recording() -> None:
    assert not recording()
    with cuda_graphs._recording():
        with cuda_graphs._recording():
            assert recording()
        assert recording()
        with ThreadPoolExecutor(1) as pool:
            assert not pool.submit(recording).result()
    assert not recording()
