"""Bounds of a view: small files that describe views of terabytes are refused, and no real view is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from sundae_ns.errors import MemoryExhaustedError
from sundae_ns.rasterization import rasterize, select_backend
from sundae_ns.rasterization import types as limits

BACKENDS = ("cpu", "reference")


def view(
    count: int, size: int, scale: float, *, spread: float = 0.0, backend: str = "reference", **options: Any
) -> Tensor:
    """The image of faint primitives in front of a camera."""
    torch.manual_seed(0)
    means = torch.cat([spread * (torch.rand(count, 2) - 0.5), torch.full((count, 1), 2.0)], dim=1)
    values = {
        "means": means.requires_grad_(options.get("training", False)),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        "scales": torch.full((count, 3), scale),
        "opacities": torch.full((count,), 0.01),
        "colors": torch.ones(count, 1),
    }
    K = torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]])
    return rasterize(
        **values, viewmat=torch.eye(4), K=K, width=size, height=size, backend=select_backend(backend, "cpu")
    ).colors


@pytest.mark.parametrize("backend", BACKENDS)
def test_more_primitives_than_in_any_scene_are_refused(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "MOST_PER_TILE", 100)
    monkeypatch.setattr(limits, "ALWAYS", 0)
    tiles = {"cpu": 64, "reference": 16}[backend]
    # Each primitive touches all tiles; four of them are its own.
    most = 100 * tiles // (tiles - 4)
    assert view(most, 64, 20.0, backend=backend).shape == (64, 64, 1)
    with pytest.raises(MemoryExhaustedError, match=r"the view has \d+ primitives in each tile .* less than 100;"):
        view(most + 1, 64, 20.0, backend=backend)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_step_of_a_training_is_not_refused(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "MOST_PER_TILE", 100)
    monkeypatch.setattr(limits, "ALWAYS", 0)
    view(200, 64, 20.0, backend=backend, training=True)
    with torch.no_grad(), pytest.raises(MemoryExhaustedError):
        view(200, 64, 20.0, backend=backend)


@pytest.mark.parametrize("backend", BACKENDS)
def test_many_small_primitives_in_a_small_image_are_drawn(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A large scene from far away, or as a thumbnail."""
    monkeypatch.setattr(limits, "ALWAYS", 0)
    assert view(60_000, 16, 1e-3, spread=1.9, backend=backend).min() > 0
    # On the corner of four tiles.
    assert view(60_000, 16, 1e-3, backend=backend).max() > 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_small_image_of_large_primitives_is_drawn(backend: str) -> None:
    """It takes little, whatever its lists."""
    assert view(20_000, 40, 20.0, backend=backend).shape == (40, 40, 1)


@pytest.mark.parametrize("backend", BACKENDS)
def test_lists_that_exceed_the_memory_are_refused(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "_NEGLIGIBLE", 0)
    monkeypatch.setattr(limits, "available_memory", lambda: 100_000)
    # In a training too, where the memory would be full all the same.
    with pytest.raises(MemoryExhaustedError, match="pairs of a tile and a primitive take .* GB, but .* are available"):
        view(1000, 64, 20.0, backend=backend, training=True)


def test_images_that_exceed_the_memory_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "available_memory", lambda: 1 << 30)
    with pytest.raises(MemoryExhaustedError, match=r"images of 65,536 x 65,536 pixels take 51\.5 GB, but 1\.1 GB are"):
        view(10, 65_536, 1e-3)


def test_the_memory_is_that_of_machine_and_control_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    memory = tmp_path / "meminfo"
    monkeypatch.setattr(limits, "_MEMORY", memory)
    monkeypatch.setattr(limits, "_CONTROL_GROUP", tmp_path)
    assert limits.available_memory() is None
    memory.write_text("MemTotal:  9000 kB\nMemAvailable:    5000 kB\n")
    assert limits.available_memory() == 5000 * 1024
    (tmp_path / "memory.max").write_text("3000000\n")
    (tmp_path / "memory.current").write_text("2500000\n")
    (tmp_path / "memory.stat").write_text("anon 1\nactive_file 100000\ninactive_file 200000\n")
    assert limits.available_memory() == 800_000
    (tmp_path / "memory.max").write_text("max\n")
    assert limits.available_memory() == 5000 * 1024
