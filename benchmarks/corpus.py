"""Feed every reader its corpus of bad input (``tests/fuzz``) and count what came of it; print one JSON line.

    python benchmarks/corpus.py > benchmarks/results/reliability/corpus.json

Exits with 1 if a case ended in anything but success or a one-line error of the package's own.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from contextlib import redirect_stdout
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


class Tally:
    """What pytest reports of each case."""

    def __init__(self) -> None:
        self.files: Counter[str] = Counter()
        self.verdicts: Counter[str] = Counter()
        self.failed: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when != "call":
            return
        found = [str(value) for name, value in report.user_properties if name == "verdict"]
        self.files[Path(report.location[0]).stem.removeprefix("test_")] += bool(found)
        self.verdicts.update(found)
        if report.failed:
            self.failed.append(report.nodeid)


def main() -> None:
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args()
    tally = Tally()
    with redirect_stdout(sys.stderr):
        code = pytest.main(["-q", "-p", "no:cacheprovider", str(ROOT / "tests" / "fuzz")], plugins=[tally])
    result = {
        "cases": sum(tally.files.values()),
        "cases_by_corpus": dict(tally.files),
        "reads": sum(tally.verdicts.values()),
        "verdicts": dict(tally.verdicts),
        "failed": tally.failed,
    }
    print(json.dumps(result))
    sys.exit(int(code != 0))


if __name__ == "__main__":
    main()
