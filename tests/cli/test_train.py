"""``sundae train``: the command that it prints is the one that it runs, and ns-train knows its options."""

import fcntl
import json
import re
import shlex
import zipfile
from pathlib import Path

import command_line
import pytest
import tyro
from colmap_models import write_model
from PIL import Image

from sundae_ns import method_configs
from sundae_ns.cli.train import methods
from sundae_ns.io.run_folder import LOCK, unfinished_run


class Commands:
    """Stands for the commands of ``sundae train``: a training leaves its run; each ends with the code it is told."""

    def __init__(self):
        self.ran = []
        self.codes = {}
        self.elsewhere = False

    def __call__(self, words):
        print(shlex.join(words))
        self.ran.append(words)
        if words[0] == "ns-train" and not self.elsewhere:
            run_of(self.run, Path(words[3]), 29999)
        return self.codes.get("--finetune" if "--finetune" in words else words[0], 0)

    @property
    def run(self):
        words = self.ran[0]
        return Path(words[5]) / "scene" / words[1] / option_of(words, "--timestamp")


@pytest.fixture
def commands(monkeypatch, tmp_path):
    """The commands, in a folder with an empty capture, ``scene``, on a machine without a GPU."""
    made = Commands()
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene/transforms.json").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sundae_ns.cli.train.run_command", made)
    monkeypatch.setattr("sundae_ns.cli.train.has_gpu", lambda: False)
    return made


def train(*words):
    return command_line.run("train", *words)


def refusal(capsys, *words):
    return command_line.refusal(capsys, "train", *words)


def option_of(words, name):
    return words[words.index(name) + 1]


def config_of(words, method="sundae"):
    """The options that ns-train reads from the words of a method and its options."""
    usual = getattr(method_configs, method.replace("-", "_")).config
    return tyro.cli(type(usual), default=usual, args=words[2:])


def run_of(folder, capture, step, *, source=None):
    """Write a run of 30,000 steps with a checkpoint of a step."""
    (folder / "nerfstudio_models").mkdir(parents=True)
    text = "!!python/object:sundae_ns.plugin.trainer.SundaeTrainerConfig\nschedule_length: 30000\n"
    for name, path in (("data", capture.absolute()), ("load_dir", source)):
        if path is not None:
            text += f"{name}: !!python/object/apply:pathlib.PosixPath\n" + "".join(f"- {part}\n" for part in path.parts)
    (folder / "config.yml").write_text(text)
    with zipfile.ZipFile(folder / "nerfstudio_models" / f"step-{step:09d}.ckpt", "w") as archive:
        archive.writestr("data.pkl", bytes(500))
    return folder


@pytest.mark.parametrize("method", methods())
def test_the_printed_command_runs(commands, capsys, method):
    assert train("scene", "-o", "my runs", "--method", method, "--steps", "700", "--keep", "0.05") == 0
    assert shlex.split(capsys.readouterr().out.splitlines()[0]) == commands.ran[0]
    assert commands.ran[0][:2] == ["ns-train", method]
    config = config_of(commands.ran[0], method)
    assert (config.data, config.output_dir, config.max_num_iterations) == (Path("scene"), Path("my runs"), 700)
    assert config.pipeline.model.pruning.keep_ratio == 0.05


def test_what_is_not_given_is_the_method_s_own(commands):
    assert train("scene") == 0
    *words, name = commands.ran[0]
    assert words == ["ns-train", "sundae", "--data", "scene", "--output-dir", "outputs", "--timestamp"]
    assert re.fullmatch(r"[\d_-]+", name), "its run is found by this name"


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
    commands.elsewhere = True
    for name in ("my scene", "other"):
        Path(name).mkdir()
        Path(name, "transforms.json").touch()
    run_of(Path("outputs/my scene/sundae/first"), Path("my scene"), 1999)
    run_of(Path("outputs/my scene/sundae/whole"), Path("my scene"), 29999)
    run_of(Path("outputs/other/sundae/first"), Path("other"), 2999)
    assert train("my scene") == 0
    first, second, command = capsys.readouterr().out.splitlines()
    assert first.startswith("# outputs/my scene/sundae/first ended after 2,000 of 30,000 steps")
    assert "--load-dir" not in command
    words = shlex.split(second.lstrip("# "))
    assert words == ["sundae", "train", "my scene", "--resume"]
    assert train(*words[2:], "--", "--vis", "tensorboard") == 0
    config = config_of(commands.ran[1])
    assert config.load_dir == Path("outputs/my scene/sundae/first/nerfstudio_models")
    assert (config.experiment_name, config.timestamp, config.vis) == ("my scene", "first", "tensorboard")
    assert not capsys.readouterr().out.startswith("#")
    # Another method or folder has no such run.
    for more in (["--method", "sundae-tiny"], ["-o", "elsewhere"]):
        assert "no unfinished run" in refusal(capsys, "my scene", "--resume", *more)


def test_a_run_that_another_one_has_resumed_or_that_is_trained_is_not_named(tmp_path):
    out, capture = tmp_path / "outputs", tmp_path / "scene"
    first = run_of(out / "scene" / "sundae" / "first", capture, 1999)
    assert unfinished_run(out, "sundae", capture) == (first, 2000, 30000)
    with (first / LOCK).open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert unfinished_run(out, "sundae", capture) is None
    run_of(out / "scene" / "sundae" / "second", capture, 29999, source=first / "nerfstudio_models")
    assert unfinished_run(out, "sundae", capture) is None


def test_a_finished_training_is_packed(commands, capsys):
    assert train("scene") == 0
    _, pack = commands.ran
    assert pack == ["sundae", "pack", str(commands.run), "-o", str(commands.run / "scene.sundae")]
    assert capsys.readouterr().out.splitlines()[-1] == shlex.join(pack), "the command is printed"


@pytest.mark.parametrize("given", [["--timestamp", "mine"], ["--timestamp=mine"]])
def test_a_run_of_the_user_s_own_name_is_packed(commands, given):
    run_of(Path("outputs/scene/sundae/other"), Path("scene"), 29999)
    commands.elsewhere = True
    run_of(Path("outputs/scene/sundae/mine"), Path("scene"), 29999)
    assert train("scene", "--", *given) == 0
    assert [words[2] for words in commands.ran[1:]] == ["outputs/scene/sundae/mine"]
    assert sum("--timestamp" in word for word in commands.ran[0]) == 1


@pytest.mark.parametrize(("failed", "last"), [(False, "--finetune"), (True, "scene.sundae")])
def test_a_gpu_fine_tunes_the_pack_or_leaves_it(commands, monkeypatch, capsys, failed, last):
    monkeypatch.setattr("sundae_ns.cli.train.has_gpu", lambda: True)
    commands.codes = {"--finetune": int(failed)}
    assert train("scene") == 0
    training, *packs = commands.ran
    assert option_of(training, "--finetune-steps") == "1500", "in place of the last steps"
    assert packs[0][-2:] == ["--finetune", "1500"]
    assert len(packs) == 1 + failed
    assert ("# the fine-tune ended with 1; packing without it:\n" in capsys.readouterr().out) == failed
    assert any(last in word for word in packs[-1][-2:])


@pytest.mark.parametrize("length", ["--max-num-iterations", "--schedule-length", "--finetune-steps"])
def test_a_length_of_ns_train_is_the_user_s(commands, monkeypatch, length):
    monkeypatch.setattr("sundae_ns.cli.train.has_gpu", lambda: True)
    assert train("scene", "--", length, "40000") == 0
    assert sum(word.startswith("--finetune-steps") for word in commands.ran[0]) == (length == "--finetune-steps")


def test_a_run_that_its_fine_tune_has_finished_is_no_interrupted_one(commands, capsys):
    run = run_of(Path("outputs/scene/sundae/tuned"), Path("scene"), 28499)
    (run / "scene.sundae").touch()
    assert train("scene") == 0
    assert "# " not in capsys.readouterr().out
    assert "--overwrite" not in commands.ran[-1]
    commands.ran.clear()
    commands.elsewhere = True
    assert train("scene", "--resume") == 0
    resumed, pack = commands.ran
    assert option_of(resumed, "--load-dir") == str(run / "nerfstudio_models")
    assert (pack[2], pack[-1]) == (str(run), "--overwrite"), "the new steps take the place of their pack"


@pytest.mark.parametrize("stage", ["ns-train", "--finetune", "sundae"])
def test_what_ends_early_ends_the_command(commands, monkeypatch, stage):
    monkeypatch.setattr("sundae_ns.cli.train.has_gpu", lambda: stage == "--finetune")
    commands.codes = {stage: 130}
    assert train("scene") == 130
    assert len(commands.ran) == (1 if stage == "ns-train" else 2)


def test_a_run_that_is_not_found_is_not_packed(commands):
    commands.elsewhere = True
    assert train("scene", "--", "--output-dir", "own") == 0
    assert len(commands.ran) == 1
