"""Memory and time of a prune: stated, checked, and bounded."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from fields import random_field
from short_prunes import short_prunes  # noqa: F401
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import sundae_ns as sn
from sundae_ns.api import cost, opening, pruning
from sundae_ns.cli import main
from sundae_ns.errors import MemoryExhaustedError
from sundae_ns.gaussians import covariance
from sundae_ns.pruning import PruneRule, prune_field, redistribution
from sundae_ns.storage import write_ply
from sundae_ns.storage.ply import stated_size

resource = pytest.importorskip("resource", reason="Windows has none")
N = 2000


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_ply(tmp_path / "a.ply", random_field(N, degree=3, features=0))
    return tmp_path / "a.ply"


def unreachable(*_: object, **__: object) -> None:
    pytest.fail("it was started")


@pytest.mark.usefixtures("short_prunes")
def test_a_prune_that_does_not_fit_is_refused_before_it_starts(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = sn.load(file)
    monkeypatch.setattr(cost, "free_memory", lambda: 500_000)
    monkeypatch.setattr(pruning, "contribution", unreachable)
    with pytest.raises(MemoryExhaustedError, match=r"2,000 primitives .* GB are free.*top and no merge take") as caught:
        sn.prune(scene, keep=0.1)
    assert "\n" not in str(caught.value)
    monkeypatch.setattr(cost, "free_memory", lambda: 1_000_000)  # for draws, not for pairs
    with pytest.raises(MemoryExhaustedError, match="with more; selection systematic takes"):
        sn.prune(scene, keep=0.1)
    monkeypatch.setattr(cost, "free_memory", lambda: 100_000)
    with pytest.raises(MemoryExhaustedError, match="with more$"):
        sn.prune(scene, keep=0.1)


def test_a_file_that_does_not_fit_is_refused_before_it_is_read(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert stated_size(file) == (N, 59)
    monkeypatch.setattr(cost, "free_memory", lambda: 1_000_000)  # the prune alone would fit
    monkeypatch.setattr(opening, "load_with_mask", unreachable)
    with pytest.raises(SystemExit) as end:
        main(["prune", str(file), "-o", str(file.with_name("b.ply"))])
    assert end.value.code == 2
    assert capsys.readouterr().err.startswith("sundae: a prune of 2,000 primitives takes about 0.0 GB of memory")


@pytest.mark.usefixtures("short_prunes")
def test_a_long_prune_states_its_cost(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["prune", str(file), "--views", "2", "-o"]
    for limit, stated in ((60.0, False), (0.0, True)):
        monkeypatch.setattr(cost, "LONG", limit)
        with pytest.raises(SystemExit) as end:
            main([*words, str(file.with_name(f"{limit}.ply"))])
        assert not end.value.code
        assert (
            capsys.readouterr().err.count("2,000 primitives, 2 cameras: about 0.0 GB of memory and seconds") == stated
        )


def test_a_file_states_its_cost_before_it_is_read(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cost, "LONG", 0.0)
    monkeypatch.setattr(opening, "load_with_mask", lambda _: sys.exit(3))
    with pytest.raises(SystemExit) as end:
        main(["prune", str(file), "-o", str(file.with_name("b.ply"))])
    assert end.value.code == 3
    assert capsys.readouterr().err.startswith("2,000 primitives, 128 cameras: about 0.0 GB of memory")


def test_free_memory_obeys_the_limit_of_the_process() -> None:
    whole = cost.free_memory()
    assert whole is not None
    assert whole > 1e8
    limits = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 10**8, limits[1]))
    try:
        assert 0 <= (cost.free_memory() or 0) <= 10**8
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)


class Doubles(TorchDispatchMode):
    """Collects the numbers of elements of the float64 tensors that are made."""

    def __init__(self) -> None:
        super().__init__()
        self.sizes: list[int] = []

    def __torch_dispatch__(self, function: Any, types: Any, arguments: Any = (), options: Any = None) -> Any:
        made = function(*arguments, **(options or {}))
        for value in tree_leaves(made):
            if isinstance(value, torch.Tensor) and value.dtype == torch.float64:
                self.sizes.append(value.numel())
        return made


def test_values_between_are_computed_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of twenty million primitives, each number of an edge in float64 takes 2.6 GB."""
    for module, name, size in ((covariance, "ROWS", 64), (redistribution, "ROWS", 64), (covariance, "PAIRS", 1024)):
        monkeypatch.setattr(module, name, size)
    weights = torch.rand(N, generator=torch.Generator().manual_seed(0))
    with Doubles() as found:
        prune_field(random_field(N), PruneRule(), N // 10, weights)
    assert max(found.sizes) == 9 * N  # the covariances
    assert found.sizes.count(9 * N) == 1
