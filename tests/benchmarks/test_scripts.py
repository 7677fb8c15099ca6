"""Scripts of ``benchmarks/``: their help, their results, and the tables that they write into README and docs."""

import ast
import runpy
import sys
from pathlib import Path

import pytest

from harness.rows import Rows, read_rows

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "benchmarks"
SCRIPTS = sorted({path.name for path in FOLDER.glob("*.py")} - {"mcmc.py"})  # which is a method of ns-train


@pytest.mark.parametrize("name", SCRIPTS)
def test_help(name, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as caught:
        runpy.run_path(str(FOLDER / name), run_name="__main__")
    assert caught.value.code == 0
    assert capsys.readouterr().out.startswith(f"usage: {name}")
    assert f"python benchmarks/{name}" in (ast.get_docstring(ast.parse((FOLDER / name).read_text())) or "")


def test_tables_of_all_pages_are_those_of_the_results(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    tables = runpy.run_path(str(FOLDER / "tables.py"))
    for page in tables["PAGES"]:
        text = page.read_text(encoding="utf-8")
        assert tables["with_tables"](text) == text, f"{page.name} is not current; run: python benchmarks/tables.py"
    for path in (FOLDER / "results").iterdir():
        assert all(isinstance(row, dict) for row in tables["lines_of"](path.name)), path.name


def test_float32_is_compared_with_float64(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(FOLDER))
    stability = runpy.run_path(str(FOLDER / "stability.py"))
    for name, kept in (("SCENES", "survey coordinates of 1e7"), ("FIELDS", "collinear")):
        for case in stability[name].keys() - {kept}:
            del stability[name][case]
    reference, cpu, response = (float(row[3]) for row in stability["rows_of"](cuda=False))
    assert all(1e-8 < error < 1e-6 for error in (reference, cpu, response))
    rows = Rows(tmp_path / "a.csv", ("program", "psnr"), ("program",))
    for program in ("tool 1", "other 1", "tool 2"):  # another version
        rows.put({"program": program, "psnr": "1"})
    assert [row["program"] for row in read_rows(tmp_path / "a.csv")] == ["other 1", "tool 2"]
