"""``sundae train``: the command that it prints is the one that it runs, and ns-train knows its options."""

import fcntl
import json
import re
import shlex
from importlib.metadata import entry_points
from pathlib import Path

import command_line
import pytest
from colmap_models import write_model
from PIL import Image
from run_commands import config_of, write_run

from sundae_ns.io.run_folder import LOCK, unfinished_run


def train(*words):
    return command_line.run("train", *words)


@pytest.mark.parametrize("method", sorted(entry_points(module="sundae_ns.method_configs").names))
def test_the_printed_command_runs(commands, capsys, method):
    assert train("scene", "-o", "my runs", "--method", method, "--steps", "700", "--keep", "0.05", "--seed", "7") == 0
    assert shlex.split(capsys.readouterr().out.splitlines()[0]) == commands.ran[0]
    assert commands.ran[0][:2] == ["ns-train", method]
    config = config_of(commands.ran[0], method)
    assert (config.data, config.output_dir, config.max_num_iterations) == (Path("scene"), Path("my runs"), 700)
    pruning, seeds = config.pipeline.model.pruning, config.pipeline.datamanager.train_cameras_sampling_seed
    assert (pruning.keep_ratio, pruning.seed, seeds, config.machine.seed) == (0.05, 7, 7, 7)
    assert train("scene", "--method", method, "--max-mb", "2") == 0
    most = "--pipeline.model.pruning.max-bytes" in commands.ran[2], commands.ran[-1][-2:]
    assert most == (method == "sundae", ["--max-mb", "2.0"]), "without trials the pack alone has this size"


def test_what_is_not_given_is_the_method_s_own_and_its_run_is_packed(commands, capsys):
    assert train("scene") == 0
    *words, name = commands.ran[0]
    assert words == ["ns-train", "sundae", "--data", "scene", "--output-dir", "outputs", "--timestamp"]
    assert re.fullmatch(r"[\d_-]+", name), "its run is found by this name"
    run = commands.run_folder(0)
    assert commands.ran[1:] == [["sundae", "pack", str(run), "-o", str(run / "scene.sundae")]]
    assert capsys.readouterr().out.splitlines()[-1] == shlex.join(commands.ran[1]), "the command is printed"


def test_further_options_and_the_parser_of_a_capture(commands):
    Path("scene/transforms.json").unlink()
    Path("scene/images").mkdir()
    Image.new("RGB", (20, 16), "grey").save("scene/images/0.png")
    write_model(Path("scene/sparse/0"), ["0.png"], (20, 16))
    more = ["--pipeline.model.sh-degree", "1", "--vis", "tensorboard"]
    assert train("scene", "--steps", "9", "--", *more) == 0
    assert commands.ran[0][-9:] == [*more, "colmap", "--colmap-path", "sparse/0", "--downscale-factor", "1"]
    commands.ran.clear()
    assert train("scene", "--", *more, "colmap", "--colmap-path", "sparse/0", "--eval-mode", "all") == 0
    words = commands.ran[0]
    assert words.count("colmap") == 1, "the user's parser takes the place of ours"
    assert config_of(words[: words.index("colmap")]).pipeline.model.sh_degree == 1


@pytest.mark.parametrize(("word", "share"), [("0.25", 0.25), ("25%", 0.25), ("None", None)])
def test_a_share_of_ns_train_may_be_per_cent(word, share):
    assert config_of(["", "", "--pipeline.model.pruning.keep-ratio", word]).pipeline.model.pruning.keep_ratio == share


def test_a_capture_of_blender_is_read_over_white(commands):
    Path("scene/transforms.json").unlink()
    for split in ("train", "val", "test"):
        Path(f"scene/transforms_{split}.json").write_text(json.dumps({"frames": [{"file_path": "./0"}]}))
    Image.new("RGBA", (20, 16)).save("scene/0.png")
    for more, color in (([], "white"), (["--", "--pipeline.model.background-color", "black"], "black")):
        commands.ran.clear()
        assert train("scene", *more) == 0
        assert commands.ran[0][-1] == "blender-data"
        assert config_of(commands.ran[0][:-1]).pipeline.model.background_color == color
    commands.ran.clear()
    assert train("scene", "--", "blender-data", "--alpha-color", "black") == 0
    assert commands.ran[0][-3:] == ["blender-data", "--alpha-color", "black"]
    assert "--pipeline.model.background-color" not in commands.ran[0]


def test_an_unfinished_run_is_named_and_resumed(commands, capsys):
    commands.silent = True
    for name in ("my scene", "other"):
        Path(name).mkdir()
        Path(name, "transforms.json").touch()
    for name, stamp, step in (("my scene", "first", 1999), ("my scene", "whole", 29999), ("other", "first", 2999)):
        write_run(Path("outputs", name, "sundae", stamp), step, 30000, capture=Path(name))
    assert train("my scene") == 0
    first, command = capsys.readouterr().out.splitlines()
    assert first.startswith("# outputs/my scene/sundae/first ended after 2,000 of 30,000 steps")
    assert first.endswith("to resume the other, add --resume")
    assert "--load-dir" not in command
    assert train("my scene", "--resume", "--", "--vis", "tensorboard") == 0
    config = config_of(commands.ran[1])
    assert config.load_dir == Path("outputs/my scene/sundae/first/nerfstudio_models")
    assert (config.experiment_name, config.timestamp, config.vis) == ("my scene", "first", "tensorboard")
    assert not capsys.readouterr().out.startswith("#")
    write_run(Path("outputs", "my scene", "sundae", "second"), 999, 30000, capture=Path("my scene"))
    assert train("my scene", "--resume") == 0
    assert "sundae/second is the newest of 2 unfinished runs by their dates; to resume" in capsys.readouterr().out
    # Another method or folder has no such run.
    for more in (["--method", "sundae-tiny"], ["-o", "elsewhere"]):
        assert "no unfinished run" in command_line.refusal(capsys, "train", "my scene", "--resume", *more)


def test_a_run_that_another_one_has_resumed_or_that_is_trained_is_not_named(tmp_path):
    out, capture = tmp_path / "outputs", tmp_path / "scene"
    first = write_run(out / "scene" / "sundae" / "first", 1999, 30000, capture=capture)
    assert unfinished_run(out, "sundae", capture) == (first, 2000, 30000)
    with (first / LOCK).open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert unfinished_run(out, "sundae", capture) is None
    source = first / "nerfstudio_models"
    write_run(out / "scene" / "sundae" / "second", 29999, 30000, capture=capture, source=source)
    assert unfinished_run(out, "sundae", capture) is None


def test_a_run_of_the_user_s_own_name_is_packed_if_it_is_found(commands):
    commands.silent = True
    for name in ("other", "mine"):
        write_run(Path("outputs/scene/sundae", name), 99, capture=Path("scene"))
    for given in (["--timestamp", "mine"], ["--timestamp=mine"]):
        commands.ran.clear()
        assert train("scene", "--", *given) == 0
        assert [words[2] for words in commands.ran[1:]] == ["outputs/scene/sundae/mine"]
        assert sum("--timestamp" in word for word in commands.ran[0]) == 1
    commands.ran.clear()
    assert train("scene", "--", "--output-dir", "own") == 0
    assert len(commands.ran) == 1


@pytest.mark.parametrize(("failed", "last"), [(False, "--finetune"), (True, "scene.sundae")])
def test_a_gpu_fine_tunes_the_pack_or_leaves_it(commands, capsys, failed, last):
    commands.gpu, commands.codes = True, {"--finetune": int(failed)}
    assert train("scene") == 0
    _, *packs = commands.ran
    assert commands.option("--finetune-steps", 0) == "1500", "in place of the last steps"
    assert packs[0][-2:] == ["--finetune", "1500"]
    assert len(packs) == 1 + failed
    assert ("# the fine-tune ended with 1; packing without it:\n" in capsys.readouterr().out) == failed
    assert any(last in word for word in packs[-1][-2:])


@pytest.mark.parametrize("length", ["--max-num-iterations", "--schedule-length", "--finetune-steps"])
def test_a_length_of_ns_train_is_the_user_s(commands, length):
    commands.gpu = True
    assert train("scene", "--", length, "40000") == 0
    assert sum(word.startswith("--finetune-steps") for word in commands.ran[0]) == (length == "--finetune-steps")


def test_a_run_that_its_fine_tune_has_finished_is_no_interrupted_one(commands, capsys):
    run = write_run(Path("outputs/scene/sundae/tuned"), 28499, 30000, capture=Path("scene"))
    (run / "scene.sundae").touch()
    assert train("scene") == 0
    assert "# " not in capsys.readouterr().out
    assert "--overwrite" not in commands.ran[-1]
    commands.ran.clear()
    commands.silent = True
    assert train("scene", "--resume") == 0
    _, pack = commands.ran
    assert commands.option("--load-dir", 0) == str(run / "nerfstudio_models")
    assert (pack[2], pack[-1]) == (str(run), "--overwrite"), "the new steps take the place of their pack"


@pytest.mark.parametrize("stage", ["ns-train", "--finetune", "sundae pack"])
def test_what_ends_early_ends_the_command(commands, stage):
    commands.gpu, commands.codes = stage == "--finetune", {stage: 130}
    assert train("scene") == 130
    assert len(commands.ran) == (1 if stage == "ns-train" else 2)
