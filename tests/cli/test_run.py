"""``sundae run``: its steps, what it skips, what it refuses; integration/test_run.py trains."""

from __future__ import annotations

import json
import shlex
import shutil
import struct
from pathlib import Path

import pytest

from sundae_ns.cli import main

PHOTOS = 8
STEPS = ["ns-process-data", "ns-train", "ns-eval", "sundae pack", "sundae report", "sundae export"]
NAMES = ["camera poses", "train", "evaluate", "pack", "report", "web page"]


class Commands:
    """Stands for the commands: each writes what the real one writes last, and can be told to end otherwise."""

    def __init__(self) -> None:
        self.ran: list[list[str]] = []
        self.codes: dict[str, int] = {}
        self.placed = PHOTOS
        self.models: list[int] = []
        """Number of photos of each model of COLMAP."""
        self.saved_at = {0: 99, 130: 39}
        """Step of the checkpoint, by the exit code of the training."""
        self.silent = False

    def __call__(self, words: list[str]) -> int:
        self.ran.append(list(words))
        name = self.names[-1]
        code = self.codes.get(name, 0)
        if not self.silent:
            self.write(name, words, code)
        return code

    @property
    def names(self) -> list[str]:
        return [" ".join(words[:2]) if words[0] == "sundae" else words[0] for words in self.ran]

    def option(self, name: str, place: int = -1) -> str:
        return self.ran[place][self.ran[place].index(name) + 1]

    def write(self, name: str, words: list[str], code: int) -> None:
        if name == "ns-train":
            names = ("--output-dir", "--experiment-name", "--timestamp")
            root, experiment, stamp = (self.option(each) for each in names)
            folder = Path(root, experiment, words[1], stamp)
            (folder / "nerfstudio_models").mkdir(parents=True, exist_ok=True)
            (folder / "config.yml").write_text(
                "!!python/object:sundae_ns.trainer.SundaeTrainerConfig\nschedule_length: 100\n"
            )
            if code in self.saved_at:
                (folder / "nerfstudio_models" / f"step-{self.saved_at[code]:09d}.ckpt").touch()
        elif code:
            return
        elif name == "ns-process-data":
            capture, placed = Path(self.option("--output-dir")), self.placed
            if "--skip-colmap" in words:
                placed = self.models[int(Path(self.option("--colmap-model-path")).name)]
            else:
                shutil.copytree(self.option("--data"), capture / "images")
                for index, images in enumerate(self.models):
                    model = capture / "colmap" / "sparse" / str(index)
                    model.mkdir(parents=True)
                    (model / "images.bin").write_bytes(struct.pack("<Q", images) + bytes(100 * images))
            (capture / "transforms.json").write_text(json.dumps({"frames": [{}] * placed}))
        elif name == "ns-eval":
            Path(self.option("--output-path")).write_text("{}")
        elif name in ("sundae pack", "sundae export"):
            Path(self.option("-o")).touch()
        else:
            Path(self.option("-o")).mkdir(exist_ok=True)
            (Path(self.option("-o")) / "report.md").touch()


@pytest.fixture
def commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Commands:
    """The commands, in a folder with photos, on a machine with COLMAP and ffmpeg."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    for index in range(PHOTOS):
        (tmp_path / "photos" / f"{index}.JPG").touch()
    program(tmp_path, "colmap", "COLMAP 3.9 (without CUDA)")
    program(tmp_path, "ffmpeg", "")
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    made = Commands()
    monkeypatch.setattr("sundae_ns.cli.run.run_in_group", made)
    return made


def program(folder: Path, name: str, says: str) -> None:
    path = folder / "bin" / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"#!/bin/sh\necho '{says}'\n")
    path.chmod(0o755)


def run(*words: str) -> int:
    with pytest.raises(SystemExit) as caught:
        main(["run", *words])
    assert isinstance(caught.value.code, int)
    return caught.value.code


def refusal(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert run(*words) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("sundae: ")
    return line


def test_photos_become_a_scene_and_a_report(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("photos", "-o", "out", "--keep", "0.2", "--steps", "100") == 0
    assert commands.names == STEPS
    # Each command is printed before it runs.
    printed = [shlex.split(line) for line in capsys.readouterr().out.splitlines() if not line.startswith("#")]
    assert printed[:-1] == commands.ran
    assert printed[-1] == ["ns-viewer", "--load-config", "out/runs/photos/sundae/run/config.yml"]
    assert commands.option("--matching-method", 0) == "exhaustive"
    assert commands.option("--pipeline.model.pruning.keep-ratio", 1) == "0.2"
    assert commands.option("--max-num-iterations", 1) == "100"
    for place in (1, 3, 4):
        assert commands.option("--data", place) == "out/capture"


def test_what_is_done_is_skipped(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("photos", "-o", "out") == 0
    commands.ran.clear()
    capsys.readouterr()
    assert run("photos", "-o", "out") == 0
    assert commands.ran == []
    assert capsys.readouterr().out.count(": done\n") == 7


def test_the_largest_model_of_colmap_is_trained(commands: Commands) -> None:
    commands.models, commands.placed = [5, PHOTOS - 1, 2], 5
    assert run("photos", "-o", "out") == 0
    assert commands.names == [STEPS[0], *STEPS]
    assert commands.option("--colmap-model-path", 1) == "colmap/sparse/1"
    assert "--skip-image-processing" in commands.ran[1]
    commands.ran.clear()
    # Frames that a user removes stay removed.
    Path("out/capture/transforms.json").write_text(json.dumps({"frames": [{}] * 4}))
    assert run("photos", "-o", "out") == 0
    assert commands.ran == []


def test_one_model_of_colmap_is_left_as_it_is(commands: Commands) -> None:
    commands.models = [PHOTOS]
    assert run("photos", "-o", "out") == 0
    assert commands.names == STEPS


@pytest.mark.parametrize(("step", "name"), zip(STEPS, NAMES))
def test_a_step_that_fails_ends_with_its_code_and_is_repeated(
    commands: Commands, capsys: pytest.CaptureFixture[str], step: str, name: str
) -> None:
    commands.codes[step] = 3
    assert run("photos", "-o", "out") == 3
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line == f"sundae: {name} ended with 3; the same command tries it again"
    commands.codes.clear()
    commands.ran.clear()
    assert run("photos", "-o", "out") == 0
    assert commands.names == STEPS[STEPS.index(step) :]


def test_an_interrupted_training_resumes(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    commands.codes["ns-train"] = 130
    assert run("photos", "-o", "out", "--steps", "100") == 130
    assert "the same command continues here" in capsys.readouterr().err
    commands.codes.clear()
    assert run("photos", "-o", "out", "--steps", "100") == 0
    assert commands.names == ["ns-process-data", "ns-train", *STEPS[1:]]
    saved = "out/runs/photos/sundae/run/nerfstudio_models"
    assert commands.option("--load-dir", 2) == saved
    assert "--max-num-iterations" not in commands.ran[2]
    # All else is the same, so that the run goes on in its folder.
    assert [word for word in commands.ran[2] if word not in ("--load-dir", saved)] == [
        word for word in commands.ran[1] if word not in ("--max-num-iterations", "100")
    ]


def test_a_training_without_a_checkpoint_starts_anew(commands: Commands) -> None:
    commands.codes["ns-train"] = 137
    assert run("photos", "-o", "out", "--steps", "100") == 137
    commands.codes.clear()
    assert run("photos", "-o", "out", "--steps", "100") == 0
    assert commands.ran[2] == commands.ran[1]


def test_results_of_an_older_training_are_made_again(commands: Commands) -> None:
    assert run("photos", "-o", "out") == 0
    shutil.rmtree("out/runs")
    commands.ran.clear()
    commands.codes["ns-train"] = 1
    assert run("photos", "-o", "out") == 1
    commands.codes.clear()
    assert run("photos", "-o", "out") == 0
    assert commands.names == ["ns-train", *STEPS[1:]]


def test_a_capture_needs_no_poses_and_no_colmap(commands: Commands, tmp_path: Path) -> None:
    assert run("photos", "-o", "out") == 0
    shutil.rmtree(tmp_path / "bin")
    commands.ran.clear()
    assert run("out/capture", "-o", "again") == 0
    assert commands.names == STEPS[1:]
    assert commands.option("--data", 0) == "out/capture"
    assert not Path("again/capture").exists()


@pytest.mark.parametrize("missing", ["colmap", "ffmpeg"])
def test_a_missing_program_is_named(
    commands: Commands, tmp_path: Path, capsys: pytest.CaptureFixture[str], missing: str
) -> None:
    (tmp_path / "bin" / missing).unlink()
    line = refusal(capsys, "photos", "-o", "out")
    assert f"{missing} is not installed" in line
    assert f"apt-get install {missing}" in line
    assert commands.ran == []


@pytest.mark.parametrize(
    ("says", "driver", "flags"), [("with CUDA", True, []), ("with CUDA", False, ["--no-gpu"]), ("", True, ["--no-gpu"])]
)
def test_colmap_without_a_gpu_is_told_so(
    commands: Commands, tmp_path: Path, says: str, driver: bool, flags: list[str]
) -> None:
    program(tmp_path, "colmap", says)
    if driver:
        program(tmp_path, "nvidia-smi", "")
    assert run("photos", "-o", "out") == 0
    assert [word for word in commands.ran[0] if word == "--no-gpu"] == flags


@pytest.mark.parametrize(("placed", "enough"), [(2, False), (3, False), (4, True)])
def test_too_few_placed_photos(
    commands: Commands, capsys: pytest.CaptureFixture[str], placed: int, enough: bool
) -> None:
    commands.placed = placed
    if enough:
        assert run("photos", "-o", "out") == 0
        return
    for _ in range(2):  # the repeated command too, which finds the poses
        line = refusal(capsys, "photos", "-o", "out")
        assert f"COLMAP placed {placed} of {PHOTOS} photos" in line
        assert "sundae run out/capture -o OTHER" in line
    assert commands.names == ["ns-process-data"]
    assert run("out/capture", "-o", "other") == 0


def test_a_command_that_writes_nothing(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    commands.silent = True
    assert "ns-process-data ended without its result" in refusal(capsys, "photos", "-o", "out")


@pytest.mark.parametrize(
    ("words", "cause"),
    [
        (["gone", "-o", "out"], "gone does not exist"),
        (["empty", "-o", "out"], "holds no photos"),
        (["video.mp4", "-o", "out"], "ns-process-data video"),
        (["model", "-o", "out"], "colmap --colmap-path sparse/0"),
        (["photos", "-o", "photos/out"], "lies in photos"),
        (["photos", "-o", "."], "holds what the command reads"),
        (["photos", "-o", "used"], "holds files"),
        (["photos", "-o", "out", "--keep", "2"], "keep is 2.0"),
        (["photos", "-o", "out", "--steps", "0"], "steps is 0"),
    ],
)
def test_refusals_come_before_anything_is_written(
    commands: Commands, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], cause: str
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "video.mp4").touch()
    (tmp_path / "model" / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "model" / "sparse" / "0" / "cameras.bin").touch()
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "thesis.txt").touch()
    before = sorted(tmp_path.rglob("*"))
    assert cause in refusal(capsys, *words)
    assert sorted(tmp_path.rglob("*")) == before
    assert commands.ran == []


@pytest.mark.parametrize(
    ("more", "cause"),
    [
        (["--steps", "200"], "steps left out, not 200"),
        (["--keep", "0.5"], "keep left out, not 0.5"),
        (["--method", "sundae-tiny"], "method sundae, not sundae-tiny"),
    ],
)
def test_other_settings_are_refused(
    commands: Commands, capsys: pytest.CaptureFixture[str], more: list[str], cause: str
) -> None:
    assert run("photos", "-o", "out") == 0
    assert cause in refusal(capsys, "photos", "-o", "out", *more)


def test_damaged_settings(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("photos", "-o", "out") == 0
    for text in ("[]", "{"):
        Path("out/run.json").write_text(text)
        assert "out/run.json is damaged" in refusal(capsys, "photos", "-o", "out")
