"""The layer rule, in fresh interpreters: a room imports only rooms on lower floors, and stays light."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "sundae_ns"
FLOORS = {
    "errors": 0,
    "graphs": 0,
    "filters": 0,
    "gpu": 0,
    "gaussians": 1,
    "rasterization": 1,
    "compensation": 1,
    "pruning": 2,
    "storage": 2,
    "evaluation": 2,
    "data": 2,
    "datamanager": 3,
    "distributed": 3,
    "model": 3,
    "rendering": 3,
    "scenes": 3,
    "trainer": 3,
    "training": 3,
    "viewer": 3,
    "method_configs": 4,
    "cli": 4,
}
# Rooms that may import a neighbour on their own floor.
SAME_FLOOR = {"graphs": {"gpu"}, "filters": {"graphs", "gpu"}}
LISTER = """
import importlib, json, pkgutil, sys
room = sys.argv[1]
module = importlib.import_module(room)
if hasattr(module, "__path__"):
    for info in pkgutil.walk_packages(module.__path__, room + "."):
        importlib.import_module(info.name)
print(json.dumps(sorted(sys.modules)))
"""


def imported_by(module: str) -> set[str]:
    """Names of all modules in a fresh interpreter after importing ``module`` and everything below it."""
    result = subprocess.run([sys.executable, "-c", LISTER, module], capture_output=True, text=True, check=True)
    return set(json.loads(result.stdout.splitlines()[-1]))


def violations(room: str, modules: set[str]) -> set[str]:
    """Modules of the package that ``room`` must not have imported, and nerfstudio or gsplat where they must not be."""
    rooms = {name.split(".")[1] for name in modules if name.startswith("sundae_ns.")} - {room}
    allowed_peers = {"errors"} | SAME_FLOOR.get(room, set())
    floor = FLOORS[room]
    found = {r for r in rooms if FLOORS[r] > floor or (floor < 3 and FLOORS[r] == floor and r not in allowed_peers)}
    if floor < 3:
        found |= modules & {"nerfstudio", "gsplat"}
    if floor == 0:
        found |= modules & {"torchvision", "PIL", "rich", "tyro"}
    return found


def test_every_room_has_a_floor() -> None:
    rooms = {p.stem for p in ROOT.iterdir() if not p.name.startswith("_") and p.suffix in ("", ".py")}
    assert rooms | {"method_configs"} == set(FLOORS)


@pytest.mark.parametrize("room", [room for room in FLOORS if FLOORS[room] < 3])
def test_room_imports_only_lower_floors(room: str) -> None:
    assert not violations(room, imported_by(f"sundae_ns.{room}"))


def test_shell_does_not_import_cli_or_configs() -> None:
    modules = imported_by("sundae_ns.model")
    assert "nerfstudio" in modules
    assert not {m for m in modules if m.startswith(("sundae_ns.cli", "sundae_ns.method_configs"))}


def test_the_detector_can_fail() -> None:
    modules = imported_by("sundae_ns.pruning")
    assert "sundae_ns.graphs" in modules
    # The same modules would be a violation had a room on a lower floor imported them.
    assert "pruning" in violations("gaussians", modules)
    assert "nerfstudio" in violations("graphs", {"nerfstudio"})
