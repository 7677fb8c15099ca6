"""``sundae run`` again: what is done is skipped, what was interrupted or harmed is made again."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from run_commands import NAMES, STEPS, Commands, run


def test_what_is_done_is_skipped(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("photos", "-o", "out") == 0
    commands.ran.clear()
    capsys.readouterr()
    assert run("photos", "-o", "out") == 0
    assert commands.ran == []
    assert capsys.readouterr().out.count(": done\n") == 5


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path: Path) -> None:
    path.write_bytes(b"")


RUN = "out/runs/photos/sundae/run"


@pytest.mark.parametrize("harm", [cut, empty, Path.unlink])
@pytest.mark.parametrize(
    ("result", "step"),
    [
        ("out/capture/transforms.json", 0),
        (f"{RUN}/config.yml", 1),
        (f"{RUN}/nerfstudio_models/step-000000099.ckpt", 1),
        ("out/scene.sundae", 2),
        ("out/report/report.html", 3),
        ("out/scene.html", 4),
    ],
)
def test_half_a_result_is_made_again(
    commands: Commands, result: str, step: int, harm: Callable[[Path], object]
) -> None:
    assert run("photos", "-o", "out") == 0
    harm(Path(result))
    commands.ran.clear()
    assert run("photos", "-o", "out") == 0
    assert commands.names[0] == STEPS[step]
    commands.ran.clear()
    assert run("photos", "-o", "out") == 0
    assert commands.ran == []


def test_a_checkpoint_before_a_damaged_one_is_resumed(commands: Commands) -> None:
    commands.codes["ns-train"] = 130
    assert run("photos", "-o", "out") == 130
    commands.codes.clear()
    Path(RUN, "nerfstudio_models", "step-000000099.ckpt").write_bytes(b"PK")
    assert run("photos", "-o", "out") == 0
    assert "--load-dir" in commands.ran[2]


def test_a_training_without_its_options_starts_anew_and_is_kept(commands: Commands) -> None:
    assert run("photos", "-o", "out") == 0
    empty(Path(RUN, "config.yml"))
    commands.codes["ns-train"] = 130
    assert run("photos", "-o", "out") == 130
    assert "--load-dir" not in commands.ran[-1]
    # Its last checkpoint is not taken for one of the new training.
    assert Path(f"{RUN}.damaged/nerfstudio_models/step-000000099.ckpt").exists()
    commands.codes.clear()
    commands.ran.clear()
    assert run("photos", "-o", "out") == 0
    assert commands.names[0] == "ns-train"
    assert "--load-dir" in commands.ran[0]


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
    assert commands.names == ["sundae poses", "ns-train", *STEPS[1:]]
    saved = "out/runs/photos/sundae/run/nerfstudio_models"
    assert commands.option("--load-dir", 2) == saved
    assert "--max-num-iterations" not in commands.ran[2]
    # All else is the same, so that the run goes on in its folder.
    assert [word for word in commands.ran[2] if word not in ("--load-dir", saved)] == [
        word for word in commands.ran[1] if word not in ("--max-num-iterations", "100")
    ]


def test_a_fine_tune_ends_the_training_where_there_is_a_gpu(commands: Commands) -> None:
    commands.gpu, commands.length, commands.saved_at[0] = True, 30000, 28499
    assert run("photos", "-o", "out") == 0
    commands.ran.clear()
    assert run("photos", "-o", "out") == 0
    assert commands.ran == [], "the fine-tune took the place of the other steps"
    commands.gpu, commands.saved_at[0] = False, 29999
    assert run("photos", "-o", "out") == 0
    assert commands.names[0] == "ns-train", "without one they are trained"
    assert "--finetune-steps" not in commands.ran[0]
    assert commands.option("--load-dir", 0) == f"{RUN}/nerfstudio_models"


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
