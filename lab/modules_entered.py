"""Modules of the package that a training step with a head enters after its prune, and those of ``sundae pack`` (CPU).

    python lab/modules_entered.py
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests/support")]

import models  # noqa: E402
import torch  # noqa: E402

import sundae_ns as sn  # noqa: E402
from sundae_ns.cli.main import main as sundae  # noqa: E402


def entered(call: Callable[..., Any], *arguments: Any) -> list[str]:
    """Modules with a function that the call runs."""
    found: set[str] = set()
    sys.setprofile(lambda frame, event, _: found.add(frame.f_globals.get("__name__", "")) if event == "call" else None)
    with suppress(SystemExit):  # that of a command
        call(*arguments)
    sys.setprofile(None)
    return sorted(name for name in found if name.startswith("sundae_ns"))


def main() -> None:
    training = models.Training(models._build())
    for step in range(8):  # it prunes after step 3
        training.step(step)
    found = {"a training step": entered(training.step, 8)}
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(sys.stderr):
        path = f"{folder}/scene.ply"
        sn.save(sn.Scene.from_points(torch.rand(3000, 3), torch.rand(3000, 3)), path)
        packing = ["pack", path, "-o", f"{folder}/scene.sundae", "--overwrite"]
        for _ in range(2):  # the first call imports
            found["sundae pack"] = entered(sundae, packing)
    for what, names in found.items():
        print(f"{what}: {len(names)}", *(name.removeprefix("sundae_ns.") for name in names), sep="\n    ")


if __name__ == "__main__":
    main()
