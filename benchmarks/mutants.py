"""Break the code that prunes, schedules, merges and packs, a small change at a time; count the changes that tests see.

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
import resource
import sys
import time
from collections.abc import Iterator
from copy import copy, deepcopy
from multiprocessing import get_context
from pathlib import Path
from typing import Any

# Imported here, and so once for all processes: all but the package and its tests.
import hypothesis  # noqa: F401
import nerfstudio.engine.optimizers
import numpy  # noqa: F401
import pytest
import scipy.spatial  # noqa: F401
import torch
from rich.console import Console
from rich.progress import track

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "sundae_ns"
SECONDS = 120
"""A changed module counts as noticed if its tests take more CPU time than this, or ten times as long: they hang."""
# Modules below the package, and tests that should notice a change in them; that named like the module runs first.
ROOMS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "pruning": (("pruning/[!_]*.py",), ("pruning/test_*.py", "scene/test_cleaning.py")),
    "schedules": (
        ("train/pruning.py", "train/choice.py"),
        ("train/test_pruning.py", "train/test_schedules.py", "train/test_choice.py", "train/test_golden_trials.py"),
    ),
    "surgery": (("core/surgery.py", "core/merging.py"), ("core/test_*.py",)),
    "packing": (("io/pack/[!_]*.py",), ("io/pack/test_*.py", "fuzz/test_readers.py")),
}
SWAPS = (
    *((ast.Lt, ast.LtE), (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq), (ast.Is, ast.IsNot), (ast.In, ast.NotIn)),
    *((ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.BitAnd, ast.BitOr), (ast.And, ast.Or)),
)
OTHERS: dict[type[ast.AST], Any] = dict([*SWAPS, *(pair[::-1] for pair in SWAPS)])
OTHERS |= {ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult}
"""The operator in place of another."""
STAYING = (ast.Raise, ast.JoinedStr, ast.Import, ast.ImportFrom)
NAMES = {"min": "max", "max": "min", "any": "all", "all": "any", "floor": "ceil", "ceil": "floor"}


def walk(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes that may change, in a fixed order."""
    yield node
    for name, value in ast.iter_fields(node):
        default = isinstance(node, ast.AnnAssign) and isinstance(getattr(node, "parent", None), ast.ClassDef)
        if name in ("annotation", "returns", "decorator_list") or (default and name == "value"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not isinstance(child, STAYING):
                child.parent = node  # type: ignore[attr-defined]
                yield from walk(child)


def changed(node: Any) -> bool:
    """Change a node, if it is of a kind that changes; whether it is."""
    if isinstance(node, ast.Compare):
        node.ops = [OTHERS[type(node.ops[0])](), *node.ops[1:]]
    elif isinstance(node, (ast.BinOp, ast.AugAssign, ast.BoolOp)) and type(node.op) in OTHERS:
        node.op = OTHERS[type(node.op)]()
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.Not, ast.Invert)):
        node.operand = ast.UnaryOp(node.op, node.operand)  # twice cancels
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        node.value = not node.value
    elif isinstance(node, ast.Constant) and isinstance(node.value, int):
        node.value += 1
    elif isinstance(node, ast.Constant) and isinstance(node.value, float):
        node.value = node.value * 2 + 1e-3
    elif isinstance(node, ast.Name) and node.id in NAMES:
        node.id = NAMES[node.id]
    elif isinstance(node, ast.Attribute) and node.attr in NAMES:
        node.attr = NAMES[node.attr]
    elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        node.value = ast.Constant(None)
    else:
        return False
    return True


def places(tree: ast.AST) -> list[int]:
    """Numbers in :func:`walk` of the nodes that can change."""
    return [number for number, node in enumerate(list(walk(tree))) if changed(copy(node))]


def change(tree: ast.AST, number: int) -> str:
    """Change a node of a tree, and describe the change."""
    node: Any = list(walk(tree))[number]
    before = ast.unparse(node)
    changed(node)
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


def tests_of(name: str, path: Path) -> list[str]:
    """The room's test files, those of the module first."""
    files = [str(file) for glob in ROOMS[name][1] for file in sorted((ROOT / "tests").glob(glob))]
    return sorted(files, key=lambda file: Path(file).stem != f"test_{path.stem}")


def noticed(tests: list[str], finder: Changed | None) -> bool:
    """Whether the tests fail, with a changed module if one is given."""
    # No alarm in the child: tests of bad input set one themselves.
    child = get_context("fork").Process(target=run_tests, args=(tests, finder))
    child.start()
    child.join(10 * SECONDS)
    child.kill()  # does nothing to one that has ended
    child.join()
    return child.exitcode != 0


def run_tests(tests: list[str], finder: Changed | None) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(1, 2)
    if finder is not None:
        sys.meta_path.insert(0, finder)
    os.chdir(ROOT)
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
    os._exit(int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *tests]) != 0))


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
        paths = [path for glob in ROOMS[name][0] for path in sorted(PACKAGE.glob(glob))]
        trees = {path: ast.parse(path.read_text()) for path in paths}
        every = [(path, number) for path, tree in trees.items() for number in places(tree)]
        if not every:
            raise SystemExit(f"{name}: no place to change; ROOMS names modules that do not exist")
        sample = sorted(random.Random(options.seed).sample(range(len(every)), min(each, len(every))))
        if noticed(tests_of(name, ROOT), None):
            raise SystemExit(f"{name}: the tests fail on the unchanged code; mend them first")
        survivors = []
        console = Console(stderr=True)
        # No thread that refreshes it: a forked child would wait for the locks of that thread.
        doing = f"Changing and testing {name}"
        for number in track(sample, doing, transient=True, auto_refresh=False, console=console):
            path, place = every[number]
            tree = deepcopy(trees[path])
            what = change(tree, place)
            if not noticed(tests_of(name, path), Changed(path, tree)):
                survivors.append(f"{path.relative_to(ROOT)}, {what}")
        killed = len(sample) - len(survivors)
        result["rooms"][name] = {"places": len(every), "mutants": len(sample), "killed": killed}
        result["survivors"] += survivors
    sums = {key: sum(room[key] for room in result["rooms"].values()) for key in ("places", "mutants", "killed")}
    percent, seconds = round(100 * sums["killed"] / sums["mutants"], 1), round(time.monotonic() - began)
    print(json.dumps({**sums, "killed_percent": percent, **result, "seconds": seconds}, indent=1))


if __name__ == "__main__":
    main()
