"""Parts of the demo; the commands that it calls are tested in integration/."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from sundae_ns.cli.demo import demo
from sundae_ns.cli.process import run_logged
from sundae_ns.errors import SundaeError


def test_a_failing_command_shows_its_last_lines_and_keeps_its_log(tmp_path: Path) -> None:
    log = tmp_path / "train.log"
    script = "import sys; print('first'); print('the cause', file=sys.stderr); sys.exit(3)"
    with pytest.raises(SundaeError, match="failed with 3") as error:
        run_logged([sys.executable, "-c", script], log)
    assert "the cause" in str(error.value)
    assert "first" in log.read_text()


def test_lines_reach_the_progress_bar(tmp_path: Path) -> None:
    lines: list[str] = []
    run_logged([sys.executable, "-c", "print('10 (50.00%)'); print('20 (100.00%)')"], tmp_path / "log", lines.append)
    assert [line.strip() for line in lines] == ["10 (50.00%)", "20 (100.00%)"]


@pytest.mark.parametrize(
    ("steps", "message"),
    [(steps, f"steps is {steps}; give at least 1") for steps in (-3, 0)] + [(300, "made"), (None, "made")],
)
def test_no_step_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps: int | None, message: str
) -> None:
    def make(scene: Path) -> None:
        scene.mkdir(parents=True)
        raise SundaeError("made")

    monkeypatch.setattr("sundae_ns.data.write_demo_capture", make)
    with pytest.raises(SundaeError, match=message) as error:
        demo(tmp_path / "demo", steps=steps)
    assert "\n" not in str(error.value)
    assert (tmp_path / "demo").exists() == (message == "made")


def test_an_interrupt_leaves_no_process_behind(tmp_path: Path) -> None:
    pids = []

    def interrupt(line: str) -> None:
        pids.append(int(line))
        raise KeyboardInterrupt

    code = "import os, time; print(os.getpid(), flush=True); time.sleep(600)"
    with pytest.raises(KeyboardInterrupt):
        run_logged([sys.executable, "-c", code], tmp_path / "log.txt", interrupt)
    with pytest.raises(ProcessLookupError):
        os.kill(pids[0], 0)
