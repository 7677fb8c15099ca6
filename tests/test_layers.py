"""The layer rule: a room imports only rooms on lower floors, type checking included, and stays light."""

from __future__ import annotations

import ast
import csv
import json
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = "sundae_ns"
TABLE = re.findall(r"^\| *([\d to]+) \| (`[^|]+) \|", (ROOT / "docs" / "architecture.md").read_text(), re.MULTILINE)
"""Floors and rooms of the table in docs/architecture.md, which alone states them."""
FLOORS = tuple(room for _, rooms in TABLE for room in re.findall(r"`(\w+)`", rooms))
"""Rooms from the lowest floor up; each has a floor of its own."""
SHELL = ("model", "trainer")
"""Only rooms above may know these."""
BARE = FLOORS[: FLOORS.index("training")]
"""Rooms that import neither nerfstudio nor gsplat when they are imported."""
MAX_MODULES = 7
"""Modules beside the folders in the package's root."""
BUDGETS = ROOT / "tests" / "budgets.csv"
"""Lines of Python of each room, which may only fall: a feature pays its lines by removing as many."""
SLACK = 20
"""Lines that a room may lie below its budget before its number has to be lowered."""
LISTER = """
import importlib, json, pkgutil, sys
for room in sys.argv[1:]:
    module = importlib.import_module(room)
    if hasattr(module, "__path__"):
        for info in pkgutil.walk_packages(module.__path__, room + "."):
            importlib.import_module(info.name)
print(json.dumps(sorted(sys.modules)))
"""


def room_of(module: str) -> str | None:
    """The room of a module of the package; None for other modules and for the package itself."""
    parts = module.split(".")
    return parts[1] if parts[0] == PACKAGE and len(parts) > 1 else None


@cache
def modules() -> dict[str, Path]:
    """Files of the package by the names of their modules."""
    names = {}
    for _, path in sources():
        parts = path.relative_to(ROOT).with_suffix("").parts
        if parts[0] != PACKAGE:
            parts = (PACKAGE, *parts)
        names[".".join(parts).removesuffix(".__init__")] = path
    return names


def imports_of(source: str) -> Iterator[str]:
    """Modules that a source imports anywhere, under ``TYPE_CHECKING`` and inside functions too."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            assert node.level == 0, "imports are absolute"
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield name if node.module == PACKAGE or name in modules() else node.module


def sources() -> Iterator[tuple[str, Path]]:
    """Every file of the package with its room."""
    for path in sorted((ROOT / PACKAGE).rglob("*.py")):
        parts = path.relative_to(ROOT / PACKAGE).with_suffix("").parts
        if parts != ("__init__",):
            yield parts[0], path
    for path in sorted((ROOT / "method_configs").rglob("*.py")):
        yield "method_configs", path


def violations(room: str, imported: Iterable[str]) -> set[str]:
    """Rooms that ``room`` must not import."""
    rooms = {found for module in imported if (found := room_of(module)) is not None} - {room}
    return {other for other in rooms if FLOORS.index(other) > FLOORS.index(room)}


def circles(edges: dict[str, set[str]]) -> list[str]:
    """Modules on a circle of imports."""
    found = []
    for start in edges:
        seen: set[str] = set()
        waiting = [start]
        while waiting:
            for target in edges.get(waiting.pop(), set()) - seen:
                seen.add(target)
                waiting.append(target)
        if start in seen:
            found.append(start)
    return found


def test_every_room_has_a_floor() -> None:
    rooms = {room for room, _ in sources()}
    assert rooms == set(FLOORS)


def test_the_table_counts_its_floors() -> None:
    """A row of several rooms states its first and its last floor."""
    counted: list[int] = []
    for stated, rooms in TABLE:
        first, *last = map(int, stated.split(" to "))
        assert first == len(counted)
        counted += [first] * rooms.count("`,") + [last[-1] if last else first]
        assert counted[-1] == len(counted) - 1
    assert len(counted) == len(FLOORS) == len(set(FLOORS))


def test_few_modules_stand_beside_the_folders() -> None:
    modules = [path.name for path in (ROOT / PACKAGE).glob("*.py") if path.name != "__init__.py"]
    assert len(modules) <= MAX_MODULES, modules


def lines_of_rooms() -> dict[str, int]:
    """Lines of each room; the package's first module and ``method_configs`` are its front."""
    lines: dict[str, int] = {}
    for path in [*modules().values(), ROOT / PACKAGE / "__init__.py"]:
        parts = path.relative_to(ROOT).with_suffix("").parts
        room = parts[1] if parts[0] == PACKAGE and parts[1] != "__init__" else "front"
        lines[room] = lines.get(room, 0) + len(path.read_text().splitlines())
    return lines


def out_of_budget(lines: dict[str, int], budgets: dict[str, int]) -> dict[str, str]:
    """Rooms with more lines than their budget, or with so many fewer that the budget has to follow."""
    return {
        room: f"{lines.get(room, 0)} lines, budget {budgets.get(room, 0)}"
        for room in lines.keys() | budgets.keys()
        if not 0 <= budgets.get(room, 0) - lines.get(room, 0) <= SLACK
    }


def test_every_room_keeps_its_budget() -> None:
    with BUDGETS.open() as file:
        budgets = {row["room"]: int(row["lines"]) for row in csv.DictReader(file)}
    assert not out_of_budget(lines_of_rooms(), budgets)


def test_rooms_import_only_lower_floors() -> None:
    found = {}
    for room, path in sources():
        wrong = violations(room, imports_of(path.read_text()))
        if wrong:
            found[str(path.relative_to(ROOT))] = wrong
    assert not found


def test_no_module_is_on_a_circle() -> None:
    assert not circles({name: set(imports_of(path.read_text())) for name, path in modules().items()})


def test_the_bare_rooms_import_neither_nerfstudio_nor_gsplat() -> None:
    command = [sys.executable, "-c", LISTER, *(f"{PACKAGE}.{room}" for room in BARE)]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert not {"nerfstudio", "gsplat"} & set(json.loads(result.stdout.splitlines()[-1]))


def test_the_detectors_can_fail() -> None:
    assert violations("gaussians", ["sundae_ns.pruning.decision", "sundae_ns.errors"]) == {"pruning"}
    source = "if TYPE_CHECKING:\n    from sundae_ns.model import SundaeModel\ndef f():\n    from sundae_ns import cli\n"
    assert violations("distributed", imports_of(source)) == {"model", "cli"}
    assert out_of_budget({"a": 10, "b": 9, "c": 1}, {"a": 10, "b": 8, "d": 90}).keys() == {"b", "c", "d"}
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == ["a", "b", "c"]


@pytest.mark.parametrize("name", SHELL)
def test_nothing_below_the_shell_knows_it(name: str) -> None:
    below = FLOORS[: FLOORS.index("datamanager")]
    assert not [
        str(path.relative_to(ROOT))
        for room, path in sources()
        if room in below and f"{PACKAGE}.{name}" in set(imports_of(path.read_text()))
    ]


def test_the_model_asks_for_no_kind() -> None:
    text = (ROOT / PACKAGE / "model.py").read_text()
    for word in ("shards", "budget", "preview"):
        assert word not in text.lower(), word
