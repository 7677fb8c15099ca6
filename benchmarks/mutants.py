"""Break the code that prunes, schedules, packs and shards, one small change at a time, and count the changes that tests
notice.

    python benchmarks/mutants.py                    # 200 changes, about half an hour on one core
    python benchmarks/mutants.py --sample 40        # a quick look
    python benchmarks/mutants.py --rooms packing --sample 50 --seed 1

A change is one of: another comparison; ``+ -``, ``* /``, ``and or``, ``True False``, ``min max``, ``any all`` or
``floor ceil`` swapped; a ``not`` dropped; an integer one higher, another number doubled; a call dropped whose result is
not used. Docstrings, annotations, error messages, decorators and defaults of options stay unchanged.

``--sample`` is spread evenly over the rooms of ``ROOMS``, drawn with a fixed seed. Each room has tests of its own, so a
change takes seconds. Each changed module runs in a process of its own, which has torch and pytest imported; nothing on
disk changes. A change that no test can tell from the original counts as unnoticed. Prints JSON.
"""

from __future__ import annotations

import argparse
import ast
import importlib.abc
import importlib.util
import json
import os
import random
import signal
import sys
import time
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

# Imported here, and so once for all processes: all but the package and its tests.
import hypothesis  # noqa: F401
import nerfstudio.engine.optimizers
import numpy  # noqa: F401
import pytest
import scipy.spatial  # noqa: F401
import torch
import zstandard  # noqa: F401
from rich.console import Console
from rich.progress import track

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "sundae_ns"
SECONDS = 120
"""A changed module counts as noticed if its tests take longer than this: they hang."""


class Room(NamedTuple):
    """Modules, and the tests that should notice a change in them."""

    modules: tuple[str, ...]
    """Globs below the package."""
    tests: tuple[str, ...]
    """Globs below ``tests``; the test named like the changed module runs first."""
    functions: tuple[str, ...] = ()
    """Only these functions change; empty for whole modules."""


ROOMS = {
    "pruning": Room(("pruning/[!_]*.py",), ("pruning/test_*.py", "train/test_schedules.py")),
    "schedules": Room(
        ("train/pruning.py", "train/choice.py"),
        ("train/test_schedules.py", "train/test_choice.py", "train/test_golden_trials.py"),
    ),
    "surgery": Room(("core/surgery.py", "core/merging.py"), ("core/test_*.py",)),
    "packing": Room(("io/pack/[!_]*.py",), ("io/pack/test_*.py", "fuzz/test_readers.py")),
}

_COMPARE: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
_NAMES = {"min": "max", "max": "min", "any": "all", "all": "any", "floor": "ceil", "ceil": "floor"}
_LEFT_ALONE = (ast.Raise, ast.JoinedStr, ast.Import, ast.ImportFrom)


def sites(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Every place that can change: its number in :func:`walk`, and the kind of change."""
    for index, node in enumerate(walk(tree)):
        if isinstance(node, ast.Compare):
            yield index, "compare"
        elif isinstance(node, (ast.BinOp, ast.AugAssign)) and type(node.op) in _ARITHMETIC:
            yield index, "arithmetic"
        elif isinstance(node, ast.BoolOp):
            yield index, "and or"
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.Not, ast.Invert)):
            yield index, "not"
        elif isinstance(node, ast.Constant) and isinstance(node.value, (bool, int, float)):
            yield index, "constant"
        elif (isinstance(node, ast.Name) and node.id in _NAMES) or (
            isinstance(node, ast.Attribute) and node.attr in _NAMES
        ):
            yield index, "name"
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
            yield index, "left out"


def walk(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes that may change, in a fixed order."""
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        if (
            isinstance(node, ast.AnnAssign)
            and name == "value"
            and isinstance(getattr(node, "parent", None), ast.ClassDef)
        ):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not isinstance(child, _LEFT_ALONE):
                child.parent = node  # type: ignore[attr-defined]
                yield from walk(child)


def change(tree: ast.AST, index: int, kind: str) -> str:
    """Change one place in ``tree``, and describe it."""
    node: Any = next(node for i, node in enumerate(walk(tree)) if i == index)
    before = ast.unparse(node)
    if kind == "compare":
        node.ops[0] = _COMPARE[type(node.ops[0])]()
    elif kind == "arithmetic":
        node.op = _ARITHMETIC[type(node.op)]()
    elif kind == "and or":
        node.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
    elif kind == "not":
        node.operand = ast.UnaryOp(node.op, node.operand)  # twice cancels
    elif kind == "constant":
        value = node.value
        node.value = (
            (not value) if isinstance(value, bool) else value + 1 if isinstance(value, int) else value * 2 + 1e-3
        )
    elif kind == "name":
        gaussians = "id" if isinstance(node, ast.Name) else "attr"
        setattr(node, gaussians, _NAMES[getattr(node, gaussians)])
    else:
        node.value = ast.Constant(None)
    return f"line {node.lineno}: {before}  ->  {ast.unparse(node)}"


class Changed(importlib.abc.SourceLoader, importlib.abc.MetaPathFinder):  # type: ignore[misc]
    """Imports one module of the package from a changed syntax tree."""

    def __init__(self, path: Path, tree: ast.AST) -> None:
        self.path, self.source = path, ast.unparse(tree)
        self.name = ".".join(path.relative_to(ROOT).with_suffix("").parts)

    def find_spec(self, name: str, *_: Any) -> Any:
        return importlib.util.spec_from_loader(name, self, origin=str(self.path)) if name == self.name else None

    def get_filename(self, fullname: str) -> str:
        return str(self.path) + " (changed)"

    def get_data(self, path: str) -> bytes:
        return self.source.encode()


def parse(room: Room) -> dict[Path, ast.Module]:
    """Syntax trees of the room's modules."""
    return {path: ast.parse(path.read_text()) for glob in room.modules for path in sorted(PACKAGE.glob(glob))}


def places(room: Room, trees: dict[Path, ast.Module]) -> list[tuple[Path, int, str]]:
    """Every place of a room that can change: module, number in :func:`walk`, kind of change."""
    found = []
    for path, tree in trees.items():
        lines = {
            line
            for node in tree.body
            if isinstance(node, ast.FunctionDef) and node.name in room.functions
            for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
        }
        nodes = list(walk(tree))
        for index, kind in sites(tree):
            node: Any = nodes[index]
            if not room.functions or node.lineno in lines:
                found.append((path, index, kind))
    return found


def tests_of(room: Room, path: Path) -> list[str]:
    """The room's test files, those of the module first."""
    files = [str(file) for glob in room.tests for file in sorted((ROOT / "tests").glob(glob))]
    return sorted(files, key=lambda file: Path(file).stem != f"test_{path.stem}")


def noticed(tests: list[str], finder: Changed | None) -> bool:
    """Whether the tests fail, with a changed module if one is given."""
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
        if finder is not None:
            sys.meta_path.insert(0, finder)
        os.chdir(ROOT)
        os._exit(int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *tests]) != 0))
    # No alarm in the child: tests of bad input set one themselves.
    began = time.monotonic()
    while time.monotonic() - began < SECONDS:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return status != 0
        time.sleep(0.01)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sample", type=int, default=200, help="number of changes, spread evenly over the rooms")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rooms", nargs="+", choices=ROOMS, default=list(ROOMS))
    options = parser.parse_args()
    torch.set_num_threads(1)
    if "sundae_ns" in sys.modules:
        raise SystemExit(f"{nerfstudio.__name__} has imported the package before it could be changed")
    each = -(-options.sample // len(options.rooms))
    began = time.monotonic()
    result: dict[str, Any] = {"seed": options.seed, "rooms": {}, "survivors": []}
    for name in options.rooms:
        room = ROOMS[name]
        trees = parse(room)
        every = places(room, trees)
        if not every:
            raise SystemExit(f"{name}: no place to change; ROOMS names modules or functions that do not exist")
        sample = sorted(random.Random(options.seed).sample(range(len(every)), min(each, len(every))))
        if noticed(tests_of(room, ROOT), None):
            raise SystemExit(f"{name}: the tests fail on the unchanged code; mend them first")
        survivors = []
        console = Console(stderr=True)
        # No thread that refreshes it: a forked child would wait for the locks of that thread.
        doing = f"Changing and testing {name}"
        for number in track(sample, doing, transient=True, auto_refresh=False, console=console):
            path, index, kind = every[number]
            tree = deepcopy(trees[path])
            what = change(tree, index, kind)
            if not noticed(tests_of(room, path), Changed(path, tree)):
                survivors.append(f"{path.relative_to(ROOT)}, {what}")
        result["rooms"][name] = {
            "places": len(every),
            "mutants": len(sample),
            "killed": len(sample) - len(survivors),
        }
        result["survivors"] += survivors
    sums = {key: sum(room[key] for room in result["rooms"].values()) for key in ("places", "mutants", "killed")}
    result = {
        **sums,
        "killed_percent": round(100 * sums["killed"] / sums["mutants"], 1),
        **result,
        "seconds": round(time.monotonic() - began),
    }
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
