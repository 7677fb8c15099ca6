"""``sundae run`` with the real commands but COLMAP's: an interrupted training, and its rest."""

from __future__ import annotations

import json
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest

from sundae_ns.cli import main
from sundae_ns.storage.kinds import kind_of
from sundae_ns.trainer import SundaeTrainer

STEPS, STOP_AT = 40, 25
Run = Callable[..., int]


@pytest.fixture
def run(tiny: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run ``sundae run`` with its commands in this process, which has imported nerfstudio; poses are the scene's."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(tiny.scene / "images", "photos")
    monkeypatch.setattr("sundae_ns.cli.run.shutil.which", lambda _: "/bin/true")
    monkeypatch.setattr("sundae_ns.cli.run._colmap_uses_gpu", lambda: False)

    def here(words: Sequence[str]) -> int:
        if words[0] == "ns-process-data":
            shutil.copytree(tiny.scene, words[words.index("--output-dir") + 1])
            return 0
        # A viewer in this process would outlive the test.
        words = ["tensorboard" if word == "viewer+tensorboard" else word for word in words]
        (command,) = entry_points(group="console_scripts", name=words[0])
        with monkeypatch.context() as patch:
            patch.setattr(sys, "argv", words)
            try:
                command.load()()
            except SystemExit as end:
                return int(end.code or 0)
        return 0

    monkeypatch.setattr("sundae_ns.cli.run.run_in_group", here)

    def sundae_run(*words: str) -> int:
        with pytest.raises(SystemExit) as caught:
            main(["run", *words])
        assert isinstance(caught.value.code, int)
        return caught.value.code

    return sundae_run


def test_photos_to_a_report_with_an_interruption(
    run: Run, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ("photos", "-o", "out", "--method", "sundae-tiny", "--keep", "0.5", "--steps", str(STEPS))
    folder = Path("out/runs/photos/sundae-tiny/run")
    trained = SundaeTrainer.train_iteration

    def interrupted(self: SundaeTrainer, step: int) -> Any:
        if step == STOP_AT:
            signal.raise_signal(signal.SIGINT)
        return trained(self, step)

    with monkeypatch.context() as patch:
        patch.setattr(SundaeTrainer, "train_iteration", interrupted)
        assert run(*words) == 130
    assert "the same command continues here" in capfd.readouterr().err
    assert [path.name for path in folder.glob("*/*.ckpt")] == [f"step-{STOP_AT:09d}.ckpt"]
    assert not Path("out/eval.json").exists()

    assert run(*words) == 0
    said = capfd.readouterr().out
    assert f"Resuming after step {STOP_AT}" in said
    assert [path.name for path in folder.glob("*/*.ckpt")] == [f"step-{STEPS - 1:09d}.ckpt"]
    (prune,) = json.loads((folder / "prune.json").read_text())
    assert prune["after"] == round(prune["before"] / 2)
    assert json.loads(Path("out/eval.json").read_text())["results"]["gaussian_count"] == prune["after"]
    assert kind_of(Path("out/scene.sundae")) == "packed"
    page = Path("out/report/report.md").read_text()
    assert "Training curves" in page
    assert "scene.sundae" in page
    assert "<canvas" in Path("out/scene.html").read_text(encoding="utf-8")

    assert run(*words) == 0
    assert capfd.readouterr().out.count(": done\n") == 7
