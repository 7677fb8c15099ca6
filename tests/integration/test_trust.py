"""Training that is killed, and faults as a user of the commands sees them."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import kill_and_resume
import pytest


def test_killed_anywhere_it_goes_on_as_if_never_killed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The short version of ``benchmarks/kill_and_resume.py``, which says where the kills fall."""
    monkeypatch.setattr(sys, "argv", ["kill_and_resume.py", "--kinds", "training", "--kills", "2"])
    with pytest.raises(SystemExit) as ended:
        kill_and_resume.main()
    assert ended.value.code == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["killed"] == found["one prune"] == found["the same result"] == found["nothing left lying"] == 2
    assert found["same seed, same result"]


def test_ns_train_shows_bad_input_in_one_line(tiny: Any, tmp_path: Path) -> None:
    data = Path(shutil.copytree(tiny.scene, tmp_path / "scene"))
    meta = json.loads((data / "transforms.json").read_text())
    meta["frames"][3]["transform_matrix"][0][3] = float("nan")
    (data / "transforms.json").write_text(json.dumps(meta))
    command = [str(Path(sys.executable).parent / "ns-train"), "sundae-tiny", "--data", str(data)]
    result = subprocess.run(
        [*command, "--output-dir", str(tmp_path / "out")],
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        check=False,
    )
    assert result.returncode == 1
    assert "Traceback" not in result.stdout + result.stderr
    line = result.stderr.splitlines()[-1]
    assert line.startswith("sundae: transforms.json, frame 3 (")
    assert line.endswith("transform_matrix is nan; it must be finite and at most 1e+12")
