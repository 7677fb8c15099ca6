"""Do one job of a comparison, as quality.py, suite.py and paper.py start it; ``OUT/jobs/KEY/job.json`` describes it.

python benchmarks/job.py OUT KEY
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import tyro

from harness.job import perform
from harness.plan import Job, job_folder
from harness.script import run_script


def job(out: Annotated[Path, tyro.conf.Positional], key: Annotated[str, tyro.conf.Positional]) -> int:
    """Train, save and measure; a job that is done is not done again.

    Args:
        out: folder of the comparison.
        key: name of the job.
    """
    plain = json.loads((job_folder(out, key) / "job.json").read_text(encoding="utf-8"))
    perform(Job(**{**plain, "options": tuple(plain["options"]), "parser": tuple(plain["parser"])}), out)
    return 0


if __name__ == "__main__":
    run_script(job, __doc__)
