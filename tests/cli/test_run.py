"""``sundae run``: its steps, what is done again, and what is refused; integration/test_run.py trains."""

import os
import shlex
import shutil
import sys
from pathlib import Path

import pytest
from colmap_models import write_model
from PIL import Image
from run_commands import NAMES, PHOTOS, STEPS, config_of, refusal, run, write_video

from sundae_ns.io import run_folder

OUT = ("photos", "-o", "out")
RUN = "out/runs/photos/sundae/run"


def started(commands, *words, codes=()):
    """Names of the commands that ``sundae run`` starts, where some end with these codes."""
    commands.ran.clear()
    commands.codes = dict(codes)
    assert run(*(words or OUT)) == max(commands.codes.values(), default=0)
    return commands.names


def test_photos_become_a_scene_and_a_report(commands, capsys):
    assert run(*OUT, "--keep", "20%", "--steps", "100") == 0
    assert commands.names == STEPS
    # Each command is printed before it runs.
    printed = [shlex.split(line) for line in capsys.readouterr().out.splitlines() if not line.startswith("#")]
    assert printed[:-1] == commands.ran
    assert printed[-1] == ["sundae", "view", "out/scene.sundae"]
    assert commands.ran[0] == ["sundae", "poses", "photos", "-o", "out/capture"]
    assert commands.option("--pipeline.model.pruning.keep-ratio", 1) == "0.2"
    assert commands.option("--max-num-iterations", 1) == "100"
    assert commands.option("--viewer.websocket-host", 1) == "127.0.0.1"
    for place in (1, 2, 3):
        assert commands.option("--data", place) == "out/capture"
    assert started(commands, *OUT, "--keep", "20%", "--steps", "100") == []
    assert capsys.readouterr().out.count(": done\n") == 5


def test_the_options_of_poses_are_passed_on(commands, capsys):
    shutil.copytree("photos", "masks")
    for path in Path("masks").iterdir():
        Image.new("L", (16, 12), 255).save(path.with_suffix(".png"))
        path.unlink()
    assert run(*OUT, "--masks", "masks", "--matching", "similar", "--frames", "99") == 0
    assert commands.ran[0][5:] == ["--matching", "similar", "--frames", "99", "--masks", "masks"]
    again = ["photos", "-o", "out", "--matching", "similar", "--frames", "99"]
    assert "not left out; repeat the first command" in refusal(capsys, *again)


def test_a_video_is_taken(commands, tmp_path):
    write_video(tmp_path / "my walk.mp4", 12)
    assert run("my walk.mp4", "-o", "out") == 0
    assert commands.ran[0] == ["sundae", "poses", "my walk.mp4", "-o", "out/capture"]
    assert commands.option("--experiment-name", 1) == "my walk"


def test_a_capture_needs_no_poses(commands):
    assert run(*OUT) == 0
    assert started(commands, "out/capture", "-o", "again") == STEPS[1:]
    assert commands.option("--data", 0) == "out/capture"
    assert started(commands, "out/capture/transforms.json", "-o", "of a file") == STEPS[1:]
    assert "of a file/runs/capture/sundae/run" in commands.ran[1]


def test_a_capture_in_colmap_layout_needs_no_poses(commands, capsys):
    shutil.copytree("photos", "photographed/dense/images")
    write_model(Path("photographed/dense/sparse"), [f"{index}.JPG" for index in range(PHOTOS)], (16, 12))
    words = ("photographed", "-o", "my scene")
    assert started(commands, *words, codes={"ns-train": 130}) == ["ns-train"]
    said = "# capture in COLMAP layout: 8 images in dense/images, poses of dense/sparse\n"
    assert capsys.readouterr().out.startswith(said)
    assert commands.option("--output-dir", 0) == "my scene/runs"
    parser = ["colmap", "--colmap-path", "dense/sparse", "--images-path", "dense/images", "--downscale-factor", "1"]
    assert commands.ran[0][-len(parser) :] == parser
    assert started(commands, *words) == STEPS[1:]
    assert commands.ran[0][-len(parser) :] == parser, "a resumed training reads the same"
    assert "--load-dir" in commands.ran[0]


def test_a_size_and_a_quality(commands):
    started(commands, *OUT, "--max-mb", "2", "--quality", "best")
    pruning = config_of(commands.ran[1]).pipeline.model.pruning
    assert (pruning.max_bytes, pruning.max_drop) == (2_000_000, 0.03)
    pruning.validate()
    assert commands.option("--max-mb", 2) == "2.0"
    started(commands, "photos", "-o", "draft", "--quality", "draft")
    assert commands.option("--max-num-iterations", 1) == "3000"
    assert "--max-mb" not in commands.ran[2]


def test_a_gpu_packs_with_a_fine_tune(commands, capsys):
    commands.gpu = True
    started(commands, *OUT, "--max-mb", "2")
    assert commands.option("--finetune", 2) == commands.option("--finetune-steps", 1) == "1500"
    assert commands.option("--max-mb", 2) == "2.0"
    # Trials count the bytes of a pack without one.
    assert commands.option("--pipeline.model.pruning.max-bytes", 1) == "3333333"
    assert shlex.join(commands.ran[2]) in capsys.readouterr().out
    for out, more, gpu in (("draft", ("--quality", "draft"), True), ("cpu", (), False)):
        commands.gpu = gpu
        started(commands, "photos", "-o", out, *more)
        assert not any("--finetune" in words for words in commands.ran)


def cut(path, size=None):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2 if size is None else size])


@pytest.mark.parametrize("figure", ["NaN", '"x"', "Infinity", "9" * 400, "[" * 99_999, None])
def test_a_report_without_figures_is_made_again(commands, figure):
    started(commands)
    report = Path("out/report/report.json")
    report.write_text("[]" if figure is None else report.read_text().replace("30.0", figure))
    assert started(commands) == STEPS[3:]


@pytest.mark.parametrize("harm", [cut, lambda path: cut(path, 0), Path.unlink], ids=["cut", "empty", "gone"])
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
def test_half_a_result_is_made_again(commands, result, step, harm):
    started(commands)
    harm(Path(result))
    assert started(commands)[0] == STEPS[step]
    assert started(commands) == []


def test_a_training_without_its_options_starts_anew_and_is_kept(commands):
    started(commands)
    cut(Path(RUN, "config.yml"), 0)
    started(commands, codes={"ns-train": 130})
    assert "--load-dir" not in commands.ran[-1]
    # Its last checkpoint is not taken for one of the new training.
    assert Path(f"{RUN}.damaged/nerfstudio_models/step-000000099.ckpt").exists()
    assert started(commands)[0] == "ns-train"
    assert "--load-dir" in commands.ran[0]


@pytest.mark.parametrize(("step", "name"), zip(STEPS, NAMES))
def test_a_step_that_fails_ends_with_its_code_and_is_repeated(commands, capsys, step, name):
    for code, says in ((2, "ended with 2, as the lines above say; mend that, and"), (137, "was killed by signal 9;")):
        started(commands, codes={step: code})
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert line.startswith(f"sundae: {name} {says} the same command ")
    commands.silent, commands.codes = True, {}
    assert f"{name} ended without its result" in refusal(capsys, *OUT)
    commands.silent = False
    assert started(commands) == STEPS[STEPS.index(step) :]


def test_an_interrupted_training_resumes(commands, capsys):
    assert started(commands, *OUT, "--steps", "100", codes={"ns-train": 137}) == STEPS[:2]
    first = commands.ran[1]
    assert started(commands, *OUT, "--steps", "100", codes={"ns-train": 130}) == ["ns-train"]
    assert "the same command continues here" in capsys.readouterr().err
    assert commands.ran[0] == first, "there was no checkpoint"
    assert started(commands, *OUT, "--steps", "100") == STEPS[1:]
    # All else is the same, so that the run goes on in its folder.
    fresh, resumed = ["--max-num-iterations", "100"], ["--load-dir", f"{RUN}/nerfstudio_models"]
    assert [word for word in commands.ran[0] if word not in resumed] == [word for word in first if word not in fresh]
    assert commands.option("--load-dir", 0) == resumed[1]


def test_a_fine_tune_ends_the_training_where_there_is_a_gpu(commands):
    commands.gpu, commands.length, commands.saved_at[0] = True, 30000, 28499
    started(commands)
    assert started(commands) == [], "the fine-tune took the place of the other steps"
    commands.gpu, commands.saved_at[0] = False, 29999
    assert started(commands)[0] == "ns-train", "without one they are trained"
    assert "--finetune-steps" not in commands.ran[0]
    assert commands.option("--load-dir", 0) == f"{RUN}/nerfstudio_models"


def test_results_of_an_older_training_are_made_again(commands):
    started(commands)
    shutil.rmtree("out/runs")
    started(commands, codes={"ns-train": 1})
    assert started(commands) == STEPS[1:]


def test_four_placed_photos_are_enough(commands, capsys):
    commands.placed = 3
    for _ in range(2):  # the repeated command too, which finds the poses
        line = refusal(capsys, *OUT)
        assert f"COLMAP placed 3 of {PHOTOS} photos; photograph the way from 2.JPG to" in line
        assert "sundae run out/capture -o OTHER" in line
    assert commands.names == ["sundae poses"]
    assert run("out/capture", "-o", "other") == 0
    commands.placed = 4
    assert started(commands, "photos", "-o", "enough") == STEPS


def test_other_or_damaged_settings_are_refused(commands, capsys):
    started(commands, *OUT, "--start-view", "99", codes={"sundae pack": 2})
    assert started(commands, *OUT, "--start-view", "2") == STEPS[2:], "a wrong view costs no training"
    capsys.readouterr()
    for more, cause in (
        (["--steps", "200"], "steps left out, not 200"),
        (["--start-view", "1"], "start-view 2, not 1"),
        (["--method", "sundae-tiny"], "method sundae, not sundae-tiny"),
        (["--max-mb", "2"], "max-mb left out, not 2.0; repeat the first command, or choose another folder"),
    ):
        assert cause in refusal(capsys, *OUT, *more)
    for text in ("[]", "{"):
        Path("out/run.json").write_text(text)
        assert "out/run.json is damaged" in refusal(capsys, *OUT)


def test_without_pycolmap_nothing_starts(commands, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert refusal(capsys, *OUT).endswith('; install it with pip install "sundae_ns[photos]"')
    assert not Path("out").exists()


def test_photos_are_judged_before_anything_starts(commands, capsys):
    for name in "abcdefghi":
        os.mkfifo(f"photos/{name}.png")
    assert "photos/i.png cannot be read (it is a pipe" in refusal(capsys, *OUT)
    assert commands.ran == []
    assert not Path("out").exists()
    Path("photos/i.png").unlink()
    assert run(*OUT) == 0
    # Photos are of no more use once there are poses.
    shutil.rmtree("photos")
    Path("photos").mkdir()
    assert run(*OUT) == 0


def test_names_with_a_dash_are_no_options(commands):
    shutil.copytree("photos", "-photos")
    assert run("./-photos", "-o", "./-out") == 0
    for words in commands.ran[1:]:
        paths = [word for word in words if "photos" in word or "out" in word.replace("--out", "")]
        assert paths
        assert all(path.startswith(("./-", "--experiment-name=")) for path in paths), words
    started(commands, "./-out/capture", "-o", "./-again", "--keep", "0.5", "--crop", 0, 0, 0, 1, 1, 1)
    assert commands.option("--data", 0) == "./-out/capture"
    assert "./-again/scene.sundae" not in commands.ran[-2], "photos show what a box leaves out"


def test_one_command_works_in_a_folder(commands, capsys, monkeypatch):
    run_folder.reserve(Path("out"))
    (other,) = run_folder._held.values()
    monkeypatch.setattr(run_folder, "_held", {})  # as if another process had reserved it
    assert refusal(capsys, *OUT).endswith(f"works in {Path('out').resolve()}; wait for it, or choose another folder")
    assert commands.ran == []
    other.close()
    # The other ended before it wrote its settings.
    assert os.listdir("out") == ["training.lock"]
    assert run(*OUT) == 0
