"""Compiled loops: exp(-x), the pixel rows of a Gaussian against all pixels, and compilation."""

import sys
import time
from types import ModuleType, SimpleNamespace

import numba
import numpy as np
import pytest
import torch
from splat_inputs import geometry

from sundae_ns.rasterize.cpu import parallel
from sundae_ns.rasterize.cpu.backend import project
from sundae_ns.rasterize.cpu.lanes import WIDTH, exp_negative, load, store
from sundae_ns.rasterize.cpu.parallel import compiled
from sundae_ns.rasterize.cpu.tiles import HALF_XX, HALF_YY, LIMIT, STEP, TILE, XY, U, V, tile_lists


@compiled
def _apply_exp_negative(x, out):
    for place in range(0, len(x), WIDTH):
        store(out, place, exp_negative(load(x, place)))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_exp_negative_is_within_one_and_a_half_units_in_the_last_place(dtype):
    x = np.concatenate([np.linspace(0, 80, 2**16 - WIDTH), np.linspace(0, 1e-6, WIDTH)]).astype(dtype)
    out = np.empty_like(x)
    _apply_exp_negative(x, out)
    exact = np.exp(-x.astype(np.longdouble))
    error = float((np.abs(out - exact) / exact).max()) / np.finfo(dtype).eps
    assert error < 1.5  # measured: 1.37 and 1.32
    assert out[0] == 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_blended_pixel_is_listed_and_few_others(dtype):
    """Round Gaussians, oblique needles, and some that the image's edge cuts off."""
    generator = torch.Generator().manual_seed(0)
    n, width, height = 400, 70, 50
    means = torch.rand(n, 3, generator=generator) * torch.tensor([2.0, 1.6, 1.0]) + torch.tensor([-1.0, -0.8, 2.0])
    scales = 10 ** (2 * torch.rand(n, 3, generator=generator) - 2.5)
    camera = torch.eye(4), torch.tensor([[80.0, 0, 35], [0, 80, 25], [0, 0, 1]])
    values = (means, torch.randn(n, 4, generator=generator), scales, *camera)
    projection = project(geometry(*(value.to(dtype) for value in values), width, height))
    # The faint opacity ends footprints inside gsplat's three-sigma bins, so the bins do not matter here.
    (lists,) = tile_lists(projection, torch.full((n,), 0.2, dtype=dtype), width, height)
    table = lists.table.astype(np.float64)
    y, x = np.mgrid[: -(-height // TILE) * TILE, : lists.columns * TILE] + 0.5
    listed = np.zeros((len(lists.ids), *x.shape), bool)
    for tile in range(len(lists.starts) - 1):
        left, top = tile % lists.columns * TILE, tile // lists.columns * TILE
        for entry in range(lists.starts[tile], lists.starts[tile + 1]):
            first, beyond = (top + STEP * int(step) for step in lists.spans[entry])
            listed[lists.ranks[entry], first:beyond, left : left + TILE] = True
    dx, dy = x - table[:, U, None, None], y - table[:, V, None, None]
    xx, xy, yy, limit = (table[:, column, None, None] for column in (HALF_XX, XY, HALF_YY, LIMIT))
    visible = xx * dx * dx + xy * dx * dy + yy * dy * dy <= limit - 1e-3
    assert not (visible & ~listed).any()
    assert visible.sum() > 0.3 * listed.sum()  # measured: 0.42


LOOP = """
import numpy as np
from sizes_of_this_test import SIZE
from sundae_ns.rasterize.cpu.parallel import compiled, parallel_for

@compiled
def loop(begin, end, out):
    for i in range(begin, end):
        out[i] = SIZE

out = np.zeros(3)
parallel_for(loop, 3, out)
"""


def test_cached_code_is_renewed_when_a_constant_of_another_module_changes(tmp_path, monkeypatch):
    source = tmp_path / "loop.py"
    source.write_text(LOOP)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))

    def run(size):
        module = ModuleType("sizes_of_this_test")
        module.SIZE = size
        monkeypatch.setitem(sys.modules, "sizes_of_this_test", module)
        made = {"__name__": "loop"}
        exec(compile(LOOP, str(source), "exec"), made)
        return made["out"].tolist(), sum(made["loop"].stats.cache_hits.values())

    assert run(1) == ([1.0, 1.0, 1.0], 0)
    assert run(1) == ([1.0, 1.0, 1.0], 1)
    assert run(2) == ([2.0, 2.0, 2.0], 0)


def test_compiles_without_a_cache_folder():
    """numba finds no folder for a function without a file, as if neither package nor home were writable."""
    made = {}
    exec(compile("def double(x):\n    return 2 * x", "<nowhere>", "exec"), made)
    assert parallel.compiled(made["double"])(4) == 8


@pytest.mark.parametrize(("folder", "often"), [("/a", "precision"), (None, "command; set NUMBA_CACHE_DIR")])
def test_a_notice_is_printed_once_for_long_compilation(monkeypatch, capsys, folder, often):
    monkeypatch.setattr(parallel, "_noticed", [])
    monkeypatch.setattr(parallel, "_NOTICE_AFTER", 0.05)

    def printed(seconds, misses):
        """What a loop prints whose compilation takes so long; as numba's, it counts calls that find no code on disk."""

        def loop(begin, end):
            time.sleep(seconds if begin == end else 0.0)

        loop.stats = SimpleNamespace(cache_misses={"types": misses} if misses else {}, cache_path=folder)
        parallel.parallel_for(loop, 3)
        return capsys.readouterr().err

    assert (printed(0.0, 1), printed(0.3, 0)) == ("", "")
    assert printed(0.3, 1).count(f"compiling the CPU rasteriser, some ten seconds, once for each {often}") == 1
    assert printed(0.3, 1) == ""
