"""Ranks over gloo: ``python rank.py FILE RANKS FOLDER SECONDS`` runs the checks of a test file on each rank.

The file's ``checks(FOLDER)`` run in their order; the error of each, or "", is written to FOLDER/rankN.json. Ranks are
forked off a process that has imported the file, so that they do not import nerfstudio themselves.
"""

import json
import multiprocessing
import runpy
import sys
import time
import traceback
from pathlib import Path

import torch
import torch.distributed as dist


def go_through(checks, rank, ranks, folder):
    dist.init_process_group("gloo", init_method=f"file://{folder / 'meeting'}", rank=rank, world_size=ranks)
    results = {}
    for name, check in checks(folder).items():
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
    checks, fork = runpy.run_path(file)["checks"], multiprocessing.get_context("fork")
    programs = [fork.Process(target=go_through, args=(checks, rank, ranks, folder)) for rank in range(ranks)]
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
