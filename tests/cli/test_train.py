"""``sundae train``: the command that it prints is the one that it runs, and ns-train knows its options."""

from __future__ import annotations

import fcntl
import json
import re
import shlex
import zipfile
from pathlib import Path

import pytest
import tyro
from colmap_models import write_model
from PIL import Image

from sundae_ns import method_configs
from sundae_ns.cli import main
from sundae_ns.cli.train import methods
from sundae_ns.io.run_folder import LOCK, unfinished_run


class Replaced(Exception):
    """In place of the command that would run."""


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    monkeypatch.setattr("sundae_ns.cli.train.has_gpu", lambda: False)
    found: list[list[str]] = []

    def replace(words: list[str]) -> int:
        print(shlex.join(words))
        assert words[0] == "ns-train"
        found.append(words)
        raise Replaced

    monkeypatch.setattr("sundae_ns.cli.train.run_command", replace)
    return found


@pytest.mark.parametrize("method", methods())
def test_the_printed_command_runs(
    tmp_path: Path, ran: list[list[str]], capsys: pytest.CaptureFixture[str], method: str
) -> None:
    words = ["train", str(tmp_path), "-o", "my runs", "--method", method, "--steps", "700"]
    with pytest.raises(Replaced):
        main([*words, "--keep", "0.05"])
    (line,) = capsys.readouterr().out.splitlines()
    assert shlex.split(line) == ran[0]
    assert ran[0][:2] == ["ns-train", method]
    usual = getattr(method_configs, method.replace("-", "_")).config
    config = tyro.cli(type(usual), default=usual, args=ran[0][2:])
    assert (config.data, config.output_dir, config.max_num_iterations) == (tmp_path, Path("my runs"), 700)
    assert config.pipeline.model.pruning.keep_ratio == 0.05


def test_what_is_not_given_is_the_method_s_own(tmp_path: Path, ran: list[list[str]]) -> None:
    with pytest.raises(Replaced):
        main(["train", str(tmp_path)])
    (*words, option, name) = ran[0]
    assert [*words, option] == ["ns-train", "sundae", "--data", str(tmp_path), "--output-dir", "outputs", "--timestamp"]
    assert re.fullmatch(r"[\d_-]+", name), "its run is found by this name"


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        (["--keep", "0"], "keep is 0.0"),
        (["--keep", "1.5"], "keep is 1.5"),
        (["--steps", "0"], "steps is 0"),
        (["--method", "splatfacto"], "splatfacto is no method of sundae; use one of sundae, "),
        (["gone"], "gone does not exist"),
    ],
)
def test_refusals_are_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    ran: list[list[str]],
    options: list[str],
    cause: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as caught:
        main(["train", *(options if options == ["gone"] else [".", *options])])
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert cause in line
    assert ran == []


def test_further_options_and_the_parser_of_a_capture(tmp_path: Path, ran: list[list[str]]) -> None:
    capture = tmp_path / "my scene"
    (capture / "images").mkdir(parents=True)
    Image.new("RGB", (20, 16), "grey").save(capture / "images" / "0.png")
    write_model(capture / "sparse" / "0", ["0.png"], (20, 16))
    own = ["--pipeline.model.sh-degree", "1", "--vis", "tensorboard"]
    with pytest.raises(Replaced):
        main(["train", str(capture), "--steps", "9", "--", *own])
    usual = method_configs.sundae.config
    assert ran[0][-9:] == [*own, "colmap", "--colmap-path", "sparse/0", "--downscale-factor", "1"]
    with pytest.raises(Replaced):
        main(["train", str(capture), "--", *own, "colmap", "--colmap-path", "sparse/0", "--eval-mode", "all"])
    assert ran[1].count("colmap") == 1, "the user's parser takes the place of ours"
    config = tyro.cli(type(usual), default=usual, args=ran[1][2 : ran[1].index("colmap")])
    assert config.pipeline.model.sh_degree == 1


def test_a_capture_of_blender_is_read_over_white(tmp_path: Path, ran: list[list[str]]) -> None:
    for split in ("train", "val", "test"):
        frames = [{"file_path": "./0"}]
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps({"frames": frames}))
    Image.new("RGBA", (20, 16)).save(tmp_path / "0.png")
    usual = method_configs.sundae.config
    for more, color in (([], "white"), (["--", "--pipeline.model.background-color", "black"], "black")):
        with pytest.raises(Replaced):
            main(["train", str(tmp_path), *more])
        assert ran[-1][-1] == "blender-data"
        assert tyro.cli(type(usual), default=usual, args=ran[-1][2:-1]).pipeline.model.background_color == color
    with pytest.raises(Replaced):
        main(["train", str(tmp_path), "--", "blender-data", "--alpha-color", "black"])
    assert ran[-1][-3:] == ["blender-data", "--alpha-color", "black"]
    assert "--pipeline.model.background-color" not in ran[-1]


def test_a_stray_word_is_no_option(tmp_path: Path, ran: list[list[str]], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["train", str(tmp_path), "photos"])
    assert "photos is no option; options of ns-train follow a --" in capsys.readouterr().err
    assert ran == []


def run_of(folder: Path, capture: Path, step: int, *, source: Path | None = None) -> Path:
    """Write a run of 30,000 steps with a checkpoint of a step."""
    (folder / "nerfstudio_models").mkdir(parents=True)
    part = "\n".join(f"- {part}" for part in capture.absolute().parts)
    text = "!!python/object:sundae_ns.plugin.trainer.SundaeTrainerConfig\nschedule_length: 30000\n"
    text += f"data: !!python/object/apply:pathlib.PosixPath\n{part}\n"
    if source is not None:
        text += "load_dir: !!python/object/apply:pathlib.PosixPath\n" + "".join(f"- {one}\n" for one in source.parts)
    (folder / "config.yml").write_text(text)
    with zipfile.ZipFile(folder / "nerfstudio_models" / f"step-{step:09d}.ckpt", "w") as archive:
        archive.writestr("data.pkl", bytes(500))
    return folder


def test_an_unfinished_run_is_named_and_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ran: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("my scene", "other"):
        (tmp_path / name).mkdir()
    run_of(Path("outputs/my scene/sundae/first"), Path("my scene"), 1999)
    run_of(Path("outputs/my scene/sundae/whole"), Path("my scene"), 29999)
    run_of(Path("outputs/other/sundae/first"), Path("other"), 2999)
    with pytest.raises(Replaced):
        main(["train", "my scene"])
    first, second, command = capsys.readouterr().out.splitlines()
    assert first.startswith("# outputs/my scene/sundae/first ended after 2,000 of 30,000 steps")
    assert "--load-dir" not in command
    words = shlex.split(second.lstrip("# "))
    assert words == ["sundae", "train", "my scene", "--resume"]
    with pytest.raises(Replaced):
        main([*words[1:], "--", "--vis", "tensorboard"])
    usual = method_configs.sundae.config
    config = tyro.cli(type(usual), default=usual, args=ran[1][2:])
    assert config.load_dir == Path("outputs/my scene/sundae/first/nerfstudio_models")
    assert (config.experiment_name, config.timestamp, config.vis) == ("my scene", "first", "tensorboard")
    assert len(capsys.readouterr().out.splitlines()) == 1
    # Another method or folder has no such run.
    for more in (["--method", "sundae-tiny"], ["-o", "elsewhere"]):
        with pytest.raises(SystemExit):
            main(["train", "my scene", "--resume", *more])
        assert "no unfinished run" in capsys.readouterr().err


def test_a_run_that_another_one_has_resumed_or_that_is_trained_is_not_named(tmp_path: Path) -> None:
    out, capture = tmp_path / "outputs", tmp_path / "scene"
    first = run_of(out / "scene" / "sundae" / "first", capture, 1999)
    assert unfinished_run(out, "sundae", capture) == (first, 2000, 30000)
    with (first / LOCK).open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert unfinished_run(out, "sundae", capture) is None
    run_of(out / "scene" / "sundae" / "second", capture, 29999, source=first / "nerfstudio_models")
    assert unfinished_run(out, "sundae", capture) is None


def test_a_resumed_run_has_its_length(tmp_path: Path, ran: list[list[str]], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["train", str(tmp_path), "--resume", "--steps", "5"])
    assert "leave out --steps or --resume" in capsys.readouterr().err


class Trained:
    """Stands for the commands of ``sundae train``: a training leaves its run; each ends with the code it is told."""

    def __init__(self) -> None:
        self.ran: list[list[str]] = []
        self.codes: dict[str, int] = {}
        self.elsewhere = False

    def __call__(self, words: list[str]) -> int:
        print(shlex.join(words))
        self.ran.append(words)
        if words[0] == "ns-train" and not self.elsewhere:
            run_of(self.run, Path(words[3]), 29999)
        return self.codes.get("--finetune" if "--finetune" in words else words[0], 0)

    @property
    def run(self) -> Path:
        words = self.ran[0]
        return Path(words[5]) / "scene" / words[1] / words[words.index("--timestamp") + 1]


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Trained:
    made = Trained()
    (tmp_path / "scene").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sundae_ns.cli.train.run_command", made)
    monkeypatch.setattr("sundae_ns.cli.train.has_gpu", lambda: False)
    return made


def exit_code(*words: str) -> int:
    with pytest.raises(SystemExit) as caught:
        main(["train", "scene", *words])
    return int(caught.value.code or 0)


def test_a_finished_training_is_packed(trained: Trained, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code() == 0
    _, pack = trained.ran
    assert pack == ["sundae", "pack", str(trained.run), "-o", str(trained.run / "scene.sundae")]
    assert capsys.readouterr().out.splitlines()[-1] == shlex.join(pack), "the command is printed"


@pytest.mark.parametrize("given", [["--timestamp", "mine"], ["--timestamp=mine"]])
def test_a_run_of_the_user_s_own_name_is_packed(trained: Trained, given: list[str]) -> None:
    run_of(Path("outputs/scene/sundae/other"), Path("scene"), 29999)
    trained.elsewhere = True
    run_of(Path("outputs/scene/sundae/mine"), Path("scene"), 29999)
    assert exit_code("--", *given) == 0
    assert [words[2] for words in trained.ran[1:]] == ["outputs/scene/sundae/mine"]
    assert sum("--timestamp" in word for word in trained.ran[0]) == 1


@pytest.mark.parametrize(("failed", "last"), [(False, "--finetune"), (True, "scene.sundae")])
def test_a_gpu_fine_tunes_the_pack_or_leaves_it(
    trained: Trained, monkeypatch: pytest.MonkeyPatch, failed: bool, last: str
) -> None:
    monkeypatch.setattr("sundae_ns.cli.train.has_gpu", lambda: True)
    trained.codes = {"--finetune": int(failed)}
    assert exit_code() == 0
    training, *packs = trained.ran
    assert option_of(training, "--finetune-steps") == "1500", "in place of the last steps"
    assert packs[0][-2:] == ["--finetune", "1500"]
    assert len(packs) == 1 + failed
    assert any(last in word for word in packs[-1][-2:])


def option_of(words: list[str], name: str) -> str:
    return words[words.index(name) + 1]


@pytest.mark.parametrize("length", ["--max-num-iterations", "--schedule-length", "--finetune-steps"])
def test_a_length_of_ns_train_is_the_user_s(trained: Trained, monkeypatch: pytest.MonkeyPatch, length: str) -> None:
    monkeypatch.setattr("sundae_ns.cli.train.has_gpu", lambda: True)
    assert exit_code("--", length, "40000") == 0
    assert sum(word.startswith("--finetune-steps") for word in trained.ran[0]) == (length == "--finetune-steps")


def test_a_run_that_its_fine_tune_has_finished_is_no_interrupted_one(
    trained: Trained, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_of(Path("outputs/scene/sundae/tuned"), Path("scene"), 28499)
    (run / "scene.sundae").touch()
    assert exit_code() == 0
    assert "# " not in capsys.readouterr().out
    assert "--overwrite" not in trained.ran[-1]
    trained.ran.clear()
    trained.elsewhere = True
    assert exit_code("--resume") == 0
    resumed, pack = trained.ran
    assert option_of(resumed, "--load-dir") == str(run / "nerfstudio_models")
    assert (pack[2], pack[-1]) == (str(run), "--overwrite"), "the new steps take the place of their pack"


@pytest.mark.parametrize("stage", ["ns-train", "--finetune", "sundae"])
def test_what_ends_early_ends_the_command(trained: Trained, monkeypatch: pytest.MonkeyPatch, stage: str) -> None:
    monkeypatch.setattr("sundae_ns.cli.train.has_gpu", lambda: stage == "--finetune")
    trained.codes = {stage: 130}
    assert exit_code() == 130
    assert len(trained.ran) == (1 if stage == "ns-train" else 2)


def test_a_run_that_is_not_found_is_not_packed(trained: Trained) -> None:
    trained.elsewhere = True
    assert exit_code("--", "--output-dir", "own") == 0
    assert len(trained.ran) == 1
