"""Training that is killed, and faults as a user of the commands sees them."""

import json
import shutil
import sys
from pathlib import Path

import kill_and_resume
import pytest

from sundae_ns.core.errors import DataError


def test_killed_anywhere_it_goes_on_as_if_never_killed(monkeypatch, capsys):
    """The short version of ``benchmarks/kill_and_resume.py``, which says where the kills fall."""
    monkeypatch.setattr(sys, "argv", ["kill_and_resume.py", "--kinds", "training", "--kills", "2"])
    with pytest.raises(SystemExit) as ended:
        kill_and_resume.main()
    assert ended.value.code == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["killed"] == found["one prune"] == found["the same result"] == found["nothing left lying"] == 2
    assert found["same seed, same result"]


def test_ns_train_names_bad_input(tiny, call_here, tmp_path):
    """In one line: test_registration.py raises such an error in a process of its own."""
    data = Path(shutil.copytree(tiny.scene, tmp_path / "scene"))
    meta = json.loads((data / "transforms.json").read_text())
    meta["frames"][3]["transform_matrix"][0][3] = float("nan")
    (data / "transforms.json").write_text(json.dumps(meta))
    with pytest.raises(
        DataError, match=r"^transforms\.json, frame 3 \(.*transform_matrix is nan; it must be finite and"
    ):
        call_here("ns-train", "sundae-tiny", "--data", data, "--output-dir", tmp_path / "out", "--vis", "tensorboard")
