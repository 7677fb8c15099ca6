"""README's measured table is what benchmarks/tables.py makes of runs.csv: figures change with files made by a command."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from sundae_ns.evaluation import read_rows

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def tables() -> ModuleType:
    spec = importlib.util.spec_from_file_location("benchmarks_tables", ROOT / "benchmarks" / "tables.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # dataclasses look their module up by name.
    import sys

    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_readmes_table_is_that_of_the_rows(tables: ModuleType) -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    made = tables.with_table(text, read_rows(tables.RUNS))
    assert text == made, "README's table is not that of runs.csv; run: python benchmarks/tables.py --readme"


def test_another_figure_would_be_another_table(tables: ModuleType) -> None:
    rows = read_rows(tables.RUNS)
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    shown = {(line.scene, line.method, line.variant, line.commit) for line in tables.SHOWN}
    changed = 0
    for i, row in enumerate(rows):
        if (row.scene, row.method, row.variant, row.commit) not in shown:
            continue
        other = [*rows[:i], replace(row, psnr=(row.psnr or 0) + 0.01), *rows[i + 1 :]]
        assert tables.with_table(text, other) != text
        changed += 1
    assert changed == len(tables.SHOWN)


def test_without_markers_nothing_is_written_over(tables: ModuleType) -> None:
    with pytest.raises(SystemExit, match="no markers"):
        tables.with_table("# A page\n\n| a | b |\n", read_rows(tables.RUNS))
