"""Ranks over gloo: ``python rank.py FILE RANKS FOLDER SECONDS`` runs the checks of a test file on each rank.

The file's ``checks(FOLDER)`` run in their order; the error of each, or "", is written to FOLDER/rankN.json. Ranks are
forked off a process that has imported the file, so that they do not import nerfstudio themselves.
"""

import importlib.util
import json
import multiprocessing
import sys
import time
import traceback
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))  # as pytest does

import torch
import torch.distributed as dist


def imported(file):
    spec = importlib.util.spec_from_file_location(Path(file).stem, file)
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module  # dataclasses look their module up by name
    spec.loader.exec_module(module)
    return module


def go_through(module, rank, ranks, folder):
    dist.init_process_group("gloo", init_method=f"file://{folder / 'meeting'}", rank=rank, world_size=ranks)
    results = {}
    for name, check in module.checks(folder).items():
        try:
            check(rank)
            results[name] = ""
        except BaseException:
            results[name] = traceback.format_exc()
            break  # the other rank may wait for this one
    (folder / f"rank{rank}.json").write_text(json.dumps(results))
    if not any(results.values()):
        dist.barrier()
        dist.destroy_process_group()


def main(file, ranks, folder, seconds):
    torch.set_num_threads(1)
    module, fork = imported(file), multiprocessing.get_context("fork")
    programs = [fork.Process(target=go_through, args=(module, rank, ranks, folder)) for rank in range(ranks)]
    end = time.monotonic() + seconds
    for program in programs:
        program.start()
    for program in programs:
        program.join(max(end - time.monotonic(), 0))
    for program in programs:
        program.kill()
        program.join()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]), float(sys.argv[4]))
