"""The layer rule: a room imports only lower rooms, type checking included, stays light, and keeps its budget."""

import ast
import csv
import json
import re
import subprocess
import sys
from collections import Counter
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = "sundae_ns"
TABLE = re.findall(r"^\| *(\d+) \| (`[^|]+) \|", (ROOT / "docs" / "architecture.md").read_text(), re.MULTILINE)
FLOORS = {room: int(floor) for floor, rooms in TABLE for room in re.findall(r"`(\w+)", rooms)}
"""Rooms with their floors: the table in docs/architecture.md alone states them."""
BARE = {"nerfstudio": "plugin", "gsplat": "train"}
"""Packages that rooms below a floor never load; gsplat's rasteriser is loaded when a backend is asked for."""
BUDGETS = ROOT / "tests" / "budgets.csv"
"""Lines of Python of each room, which may only fall: a feature pays its lines by removing as many."""
SLACK = 20  # Lines that a room may lie below its budget before its number has to be lowered
MAX_TWINS = 6  # File names that occur twice or more
LISTER = """
import importlib, json, pkgutil, sys
for floor in json.loads(sys.argv[1]):
    for room in floor:
        module = importlib.import_module("sundae_ns." + room)
        for info in pkgutil.walk_packages(module.__path__, module.__name__ + "."):
            importlib.import_module(info.name)
    print(json.dumps(sorted(sys.modules)))
"""
"""Imports rooms floor by floor; a line of modules that are loaded then for each."""


@cache
def modules():
    """Files of the package by the names of their modules."""
    names = {}
    for base in (PACKAGE, "method_configs"):
        for path in (ROOT / base).rglob("*.py"):
            parts = path.relative_to(ROOT).with_suffix("").parts
            if parts[:2] != (PACKAGE, "method_configs"):  # a link
                names[".".join(parts if parts[0] == PACKAGE else (PACKAGE, *parts)).removesuffix(".__init__")] = path
    return names


@cache
def imports():
    """What each module of the package imports."""
    return {name: set(imports_of(path.read_text())) for name, path in modules().items()}


def room_of(module):
    """The room of a module of the package; None for other modules and for the package itself."""
    parts = module.split(".")
    return parts[1] if parts[0] == PACKAGE and len(parts) > 1 else None


def imports_of(source):
    """Modules that a source imports anywhere, under ``TYPE_CHECKING`` and inside functions too."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            assert node.level == 0, "imports are absolute"
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield name if node.module == PACKAGE or name in modules() else node.module


def violations(room, imported):
    """Rooms that ``room`` must not import: those of its own floor and above."""
    rooms = {other for module in imported if (other := room_of(module)) is not None} - {room}
    return {other for other in rooms if FLOORS[other] >= FLOORS[room]}


def circles(edges):
    """Modules on a circle of imports."""

    def reached(start):
        found, waiting = set(), [start]
        while waiting:
            new = set(edges.get(waiting.pop(), ())) - found
            found |= new
            waiting += new
        return found

    return [start for start in edges if start in reached(start)]


def lines_of_rooms():
    """Lines of each room; the package's first module and ``method_configs`` are its front."""
    lines = Counter()
    for name, path in modules().items():
        room = room_of(name)
        lines["front" if room in (None, "method_configs") else room] += len(path.read_text().splitlines())
    return lines


def out_of_budget(lines, budgets):
    """Rooms with more lines than their budget, or with so many fewer that the budget has to follow."""
    return {
        room: f"{lines.get(room, 0)} lines, budget {budgets.get(room, 0)}"
        for room in lines.keys() | budgets.keys()
        if not 0 <= budgets.get(room, 0) - lines.get(room, 0) <= SLACK
    }


def test_every_room_has_a_floor_and_keeps_its_budget():
    assert {room for module in modules() if (room := room_of(module)) is not None} == FLOORS.keys()
    assert {path.name for path in (ROOT / PACKAGE).glob("*.py")} == {"__init__.py"}
    with BUDGETS.open() as file:
        budgets = {row["room"]: int(row["lines"]) for row in csv.DictReader(file)}
    assert not out_of_budget(lines_of_rooms(), budgets)


def test_file_names_are_told_apart():
    names = [path.name for path in modules().values() if path.name != "__init__.py"]
    twins = sorted({name for name in names if names.count(name) > 1})
    assert len(twins) <= MAX_TWINS, twins


def test_rooms_import_only_lower_floors_in_no_circle_and_only_the_plugin_imports_nerfstudio():
    assert not {
        module: rooms
        for module, names in imports().items()
        if (room := room_of(module)) is not None and (rooms := violations(room, names))
    }
    assert not circles(imports())
    below = {name: names for name, names in imports().items() if room_of(name) not in ("plugin", "method_configs")}
    assert not [name for name, names in below.items() if any(each.split(".")[0] == "nerfstudio" for each in names)]


def test_the_lower_rooms_do_not_load_it():
    numbers = sorted({floor for floor in FLOORS.values() if floor < max(FLOORS[room] for room in BARE.values())})
    floors = [[room for room, floor in FLOORS.items() if floor == number] for number in numbers]
    words = [sys.executable, "-c", LISTER, json.dumps(floors)]
    result = subprocess.run(words, capture_output=True, text=True, check=True)
    loaded = dict(zip(numbers, map(json.loads, result.stdout.splitlines()[-len(numbers) :]), strict=True))
    for package, room in BARE.items():
        assert package not in loaded[max(number for number in numbers if number < FLOORS[room])]


def test_the_detectors_can_fail():
    assert violations("core", ["sundae_ns.pruning.decision", "sundae_ns.core.errors"]) == {"pruning"}
    assert violations("io", ["sundae_ns.pruning.decision"]) == {"pruning"}
    source = "if TYPE_CHECKING:\n    from sundae_ns.plugin.model import M\ndef f():\n    from sundae_ns import cli\n"
    assert violations("train", imports_of(source)) == {"plugin", "cli"}
    assert out_of_budget({"a": 10, "b": 9, "c": 1}, {"a": 10, "b": 8, "d": 90}).keys() == {"b", "c", "d"}
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == ["a", "b", "c"]
