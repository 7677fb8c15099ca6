"""One rank of several over gloo: python rank.py FILE RANK RANKS FOLDER goes through the checks of a file of tests.

The file's ``checks(FOLDER)`` are called by name, in order; what went wrong in each is written to FOLDER/rankN.json.
"""

from __future__ import annotations

import importlib.util
import json
import sys
import traceback
from pathlib import Path

import torch
import torch.distributed as dist

from sundae_ns.distributed import Shards


def main(file: str, rank: int, ranks: int, folder: Path) -> None:
    torch.set_num_threads(1)
    spec = importlib.util.spec_from_file_location(Path(file).stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module  # dataclasses look their module up by name
    spec.loader.exec_module(module)
    dist.init_process_group("gloo", init_method=f"file://{folder / 'meeting'}", rank=rank, world_size=ranks)
    shards = Shards("cpu")
    said = {}
    for name, check in module.checks(folder).items():
        try:
            check(shards)
            said[name] = ""
        except BaseException:
            said[name] = traceback.format_exc()
            break  # the other rank may wait for this one
    (folder / f"rank{rank}.json").write_text(json.dumps(said))
    if not any(said.values()):
        dist.barrier()
        dist.destroy_process_group()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))
