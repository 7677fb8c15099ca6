"""The job of a capture that benchmarks/few_views.py may have cut, by words of ns-train."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from harness.plan import Job, parser_of  # noqa: E402


def few_job(capture: str, key: str, arm: str, method: str, steps: int, words: list[str]) -> Job:
    """``words`` may begin with ``--seed K``; the key of the job ends with the seed."""
    data, seed = Path(capture), 42
    if words and words[0] == "--seed":
        seed, words = int(words[1]), words[2:]
    options = tuple(words) if method == "splatfacto" else ("--pipeline.model.evaluate-prune", "False", *words)
    name = f"{key}-{seed}"
    return Job(name, "whole", data.name, arm, str(data), method, steps, seed, options=options, parser=parser_of(data))
