"""``sundae run``: its steps, what it skips, what it refuses; integration/test_run.py trains."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
import tyro
from colmap_models import write_model
from PIL import Image

from sundae_ns import method_configs
from sundae_ns.cli import main
from sundae_ns.cli.forecast import Forecast, trained_size
from sundae_ns.gaussians import from_points
from sundae_ns.storage.packing import PackedScene, fit_scene, pack_bytes

PHOTOS = 8
STEPS = ["ns-process-data", "ns-train", "sundae eval", "sundae pack", "sundae report", "sundae export"]
NAMES = ["camera poses", "train", "evaluate", "pack", "report", "web page"]


class Commands:
    """Stands for the commands: each writes what the real one writes last, and can be told to end otherwise."""

    def __init__(self) -> None:
        self.ran: list[list[str]] = []
        self.folders: list[Path | None] = []
        self.codes: dict[str, int] = {}
        self.placed = PHOTOS
        self.models: list[int] = []
        """Number of photos of each model of COLMAP."""
        self.saved_at = {0: 99, 130: 39}
        """Step of the checkpoint, by the exit code of the training."""
        self.silent = False
        self.framed = False
        """Whether images and frames have the names that the program gives, and there are smaller images."""
        self.forecast: Forecast | None = None
        self.asked: list[tuple[str, int, int]] = []

    def measured(self, *asked: Any) -> Forecast | None:
        """Stands for the process that times steps."""
        self.asked.append(asked)
        return self.forecast

    def __call__(
        self, words: list[str], *, folder: Path | None = None, locks: Sequence[int] = (), saves: bool = True
    ) -> int:
        self.ran.append(list(words))
        self.folders.append(folder)
        name = self.names[-1]
        code = self.codes.get(name, 0)
        if not self.silent:
            self.write(name, words, code)
        return code

    @property
    def names(self) -> list[str]:
        return [" ".join(words[:2]) if words[0] == "sundae" else words[0] for words in self.ran]

    def option(self, name: str, place: int = -1) -> str:
        words = self.ran[place]
        joined = [word.partition("=")[2] for word in words if word.startswith(f"{name}=")]
        return joined[0] if joined else words[words.index(name) + 1]

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
                checkpoint = folder / "nerfstudio_models" / f"step-{self.saved_at[code]:09d}.ckpt"
                with zipfile.ZipFile(checkpoint, "w") as archive:
                    archive.writestr("data.pkl", bytes(500))
        elif code:
            return
        elif name == "ns-process-data":
            assert self.folders[-1] is not None
            capture, placed = self.folders[-1] / self.option("--output-dir"), self.placed
            if "--skip-colmap" in words:
                placed = self.models[int(Path(self.option("--colmap-model-path")).name)]
            else:
                shutil.copytree(self.folders[-1] / self.option("--data"), capture / "images")
                for index, images in enumerate(self.models):
                    model = capture / "colmap" / "sparse" / str(index)
                    model.mkdir(parents=True)
                    (model / "images.bin").write_bytes(struct.pack("<Q", images) + bytes(100 * images))
            frames: list[dict[str, str]] = [{}] * placed
            if self.framed:
                frames = [{"file_path": f"images/frame_{number:05d}.jpg"} for number in range(1, placed + 1)]
                (capture / "images_2").mkdir()
                for path in sorted((capture / "images").glob("0*")):
                    path.rename(path.with_name(f"frame_{path.name}"))
                    Image.new("RGB", (8, 6)).save(capture / "images_2" / f"frame_{path.name}")
            (capture / "transforms.json").write_text(json.dumps({"frames": frames}))
        elif name == "sundae eval":
            Path(self.option("-o")).write_text('{"results": {"psnr": 20.0}}')
        elif name == "sundae pack":
            Path(self.option("-o")).write_bytes(packed())
        elif name == "sundae export":
            Path(self.option("-o")).write_text("<html><body>a scene</body></html>\n")
        else:
            folder = Path(self.option("-o"))
            folder.mkdir(exist_ok=True)
            Image.effect_noise((30, 20), 50).save(folder / "views.png")
            (folder / "report.md").write_text("# Report\n\n![PSNR of each test view](views.png)\n")


def packed() -> bytes:
    points = torch.linspace(0, 1, 30).reshape(10, 3)
    model = {"sh_degree": 0, "rasterize_mode": "classic", "background_color": "black"}
    scene = PackedScene(from_points(points, points, sh_degree=0, num_features=0), meta={"model": model})
    return pack_bytes(*fit_scene(scene))[0]


@pytest.fixture
def commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Commands:
    """The commands, in a folder with photos, on a machine with COLMAP and ffmpeg."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    for index in range(PHOTOS):
        photo(Path("photos", f"{index}.JPG"))
    program(tmp_path, "colmap", "COLMAP 3.9 (without CUDA)")
    program(tmp_path, "ffmpeg", "")
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    made = Commands()
    monkeypatch.setattr("sundae_ns.cli.run.run_in_group", made)
    monkeypatch.setattr("sundae_ns.cli.run.measured_step", made.measured)
    return made


def photo(path: Path, kind: str = "jpeg") -> None:
    Image.new("RGB", (16, 12), "grey").save(path, format=kind)


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
    assert printed[0] == ["cd", "out/capture.partial", "&&", *commands.ran[0]]
    assert printed[1:-1] == commands.ran[1:]
    assert printed[-1] == ["sundae", "view", "out/scene.sundae"]
    assert commands.option("--matching-method", 0) == "exhaustive"
    assert commands.option("--pipeline.model.pruning.keep-ratio", 1) == "0.2"
    assert commands.option("--max-num-iterations", 1) == "100"
    for place in (1, 2, 3, 4):
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


def test_a_capture_in_colmap_layout_needs_no_poses(
    commands: Commands, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(tmp_path / "bin")
    shutil.copytree("photos", "scene/dense/images")
    write_model(tmp_path / "scene" / "dense" / "sparse", [f"{index}.JPG" for index in range(PHOTOS)], (16, 12))
    assert run("scene", "-o", "my scene") == 0
    assert commands.names == STEPS[1:]
    said = "# capture in COLMAP layout: 8 images in dense/images, poses of dense/sparse\n"
    assert capsys.readouterr().out.startswith(said)
    parser = ["colmap", "--colmap-path", "dense/sparse", "--images-path", "dense/images", "--downscale-factor", "1"]
    assert commands.ran[0][-len(parser) :] == parser
    assert commands.option("--output-dir", 0) == "my scene/runs"
    commands.ran.clear()
    shutil.rmtree("my scene/runs")
    commands.codes["ns-train"] = 130
    assert run("scene", "-o", "my scene") == 130
    commands.codes.clear()
    assert run("scene", "-o", "my scene") == 0
    assert commands.ran[1][-len(parser) :] == parser, "a resumed training reads the same"
    assert "--load-dir" in commands.ran[1]


def test_a_capture_of_blender_needs_no_poses(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree("photos", "lego/train")
    for path in Path("lego/train").iterdir():
        path.rename(path.with_suffix(".png"))
    for split in ("train", "val", "test"):
        frames = [{"file_path": f"./train/{index}"} for index in range(PHOTOS)]
        Path(f"lego/transforms_{split}.json").write_text(json.dumps({"frames": frames}))
    assert run("lego", "-o", "out") == 0
    assert commands.names == STEPS[1:]
    assert capsys.readouterr().out.startswith("# capture in Blender layout: 8 training images, over white\n")
    assert commands.ran[0][-1] == "blender-data"
    assert commands.asked[0][1:] == (16, 12), "the forecast knows the size of its images"


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
        (["model", "-o", "out"], "model/sparse/0: cameras.bin ends early"),
        (["model/sparse/0", "-o", "out"], "is a COLMAP model without its images"),
        (["undistorted", "-o", "out"], "undistorted has no image 0.png, which its model dense/sparse states"),
        (["blender", "-o", "out"], "blender/transforms_train.json is not JSON"),
        (["photos", "-o", "photos/out"], "lies in photos"),
        (["photos", "-o", "."], "holds what the command reads"),
        (["photos", "-o", "used"], "holds files"),
        (["photos", "-o", "out", "--keep", "2"], "keep is 2.0"),
        (["photos", "-o", "out", "--steps", "0"], "steps is 0"),
        (["photos", "-o", "out", "--max-mb", "0"], "max-mb is 0; give at least 0.01"),
        (["photos", "-o", "out", "--max-mb", "2", "--keep", "0.1"], "--max-mb needs a method that decides"),
        (["photos", "-o", "out", "--quality", "best", "--method", "sundae-fast"], "--quality best needs a method that"),
        (["photos", "-o", "out", "--quality", "draft", "--steps", "9"], "a draft has 3,000 steps"),
        (["photos", "-o", "out", "--masks", "gone"], "gone is no folder of masks"),
        (["photos", "-o", "out", "--masks", "empty"], "photos/0.JPG has no mask 0.png in empty"),
    ],
)
def test_refusals_come_before_anything_is_written(
    commands: Commands, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], cause: str
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "video.mp4").touch()
    (tmp_path / "model" / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "model" / "sparse" / "0" / "cameras.bin").touch()
    write_model(tmp_path / "undistorted" / "dense" / "sparse", ["0.png"], (20, 16))
    (tmp_path / "blender").mkdir()
    (tmp_path / "blender" / "transforms_train.json").touch()
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


def test_a_size_and_a_quality(commands: Commands) -> None:
    assert run("photos", "-o", "out", "--max-mb", "2", "--quality", "best") == 0
    usual = method_configs.sundae.config
    words = commands.ran[1]
    config = tyro.cli(type(usual), default=usual, args=words[2:])
    assert config.pipeline.model.pruning.max_bytes == 2_000_000
    assert config.pipeline.model.pruning.max_drop == 0.03
    config.pipeline.model.pruning.validate()
    assert commands.option("--target-bytes", 3) == "2000000"
    commands.ran.clear()
    assert run("photos", "-o", "draft", "--quality", "draft") == 0
    assert commands.option("--max-num-iterations", 1) == "3000"
    assert "--target-bytes" not in commands.ran[3]


def test_a_folder_of_an_earlier_version_has_the_normal_quality(
    commands: Commands, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("photos", "-o", "out") == 0
    settings = json.loads(Path("out/run.json").read_text())
    for name in ("quality", "max_mb"):
        del settings[name]
    Path("out/run.json").write_text(json.dumps(settings))
    assert run("photos", "-o", "out") == 0
    assert "quality normal, not draft" in refusal(capsys, "photos", "-o", "out", "--quality", "draft")


def test_a_training_of_hours_on_a_cpu_is_foretold_before_it_starts(
    commands: Commands, capsys: pytest.CaptureFixture[str]
) -> None:
    commands.forecast = Forecast(2.0, 30000, "cpu")
    commands.codes["ns-train"] = 130
    assert run("photos", "-o", "out") == 130
    said, rest = capsys.readouterr().out.split("\n", 1)
    assert said.startswith(
        "# warning: 30,000 training steps take at least 16 h 40 min on this CPU, 2000 ms each at 16 x 12"
    )
    assert "--quality draft (1 h 40 min), --method sundae-tiny" in said
    assert "# step 1 of 7" in rest
    assert run("photos", "-o", "out") == 130
    assert len(commands.asked) == 1, "a resumed training has a forecast of its own"
    commands.forecast = Forecast(0.004, 30000, "cuda")
    commands.codes.clear()
    assert run("photos", "-o", "other") == 0
    assert "# forecast: 30,000 training steps take about 2 min 0 s on this GPU" in capsys.readouterr().out


def test_the_size_of_training_images(tmp_path: Path) -> None:
    assert trained_size(tmp_path) is None
    for index in range(3):
        Image.new("RGB", (4000, 30), "grey").save(tmp_path / f"{index}.png")
    assert trained_size(tmp_path) == (1000, 7)
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [{"file_path": "1.png"}]}))
    assert trained_size(tmp_path) == (1000, 7)
    (tmp_path / "transforms.json").unlink()
    write_model(tmp_path / "sparse" / "0", ["0.png"], (4000, 30))
    assert trained_size(tmp_path) == (4000, 30), "there are no smaller images"


def test_masks_reach_the_capture(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    Path("photos/masks").mkdir()
    for index in range(PHOTOS):
        mask = Image.new("L", (16, 12), 255)
        mask.putpixel((index, 0), 0)
        mask.save(f"photos/masks/{index}.png")
    commands.framed = True
    assert run("photos", "-o", "out", "--masks", "photos/masks") == 0
    said = capsys.readouterr().out
    assert f"# masks: {PHOTOS} of {PHOTOS}\n" in said
    assert "is left out" not in said
    frames = json.loads(Path("out/capture/transforms.json").read_text())["frames"]
    assert frames[2]["mask_path"] == "masks/frame_00003.png"
    with Image.open("out/capture/masks/frame_00003.png") as stored:
        assert (stored.getpixel((2, 0)), stored.getpixel((3, 0))) == (0, 255)
    with Image.open("out/capture/masks_2/frame_00003.png") as stored:
        assert (stored.size, stored.mode) == ((8, 6), "L")
    assert "not left out; repeat the first command" in refusal(capsys, "photos", "-o", "out")


def test_damaged_settings(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("photos", "-o", "out") == 0
    for text in ("[]", "{"):
        Path("out/run.json").write_text(text)
        assert "out/run.json is damaged" in refusal(capsys, "photos", "-o", "out")


HOLDER = """
import sys
from pathlib import Path
from sundae_ns.storage.runs.folder import reserve
reserve(Path("out"))
print(flush=True)
sys.stdin.read()
"""


def test_one_command_works_in_a_folder(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    other = subprocess.Popen([sys.executable, "-c", HOLDER], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    with other:
        assert other.stdout is not None
        other.stdout.readline()
        line = refusal(capsys, "photos", "-o", "out")
        assert f"process {other.pid} on " in line
        assert line.endswith(f"works in {Path('out').resolve()}; wait for it, or choose another folder")
        assert commands.ran == []
        other.kill()
    # The other was killed before it wrote its settings.
    assert os.listdir("out") == ["training.lock"]
    assert run("photos", "-o", "out") == 0


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
        ("out/eval.json", 2),
        ("out/scene.sundae", 3),
        ("out/report/report.md", 4),
        ("out/report/views.png", 4),
        ("out/scene.html", 5),
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


def test_half_a_capture_is_made_again(commands: Commands) -> None:
    """The program writes its last file in place, so it may end in the middle of it."""
    commands.models, commands.placed = [5, PHOTOS], 5
    commands.codes["ns-process-data"] = 137
    half = Path("out/capture.partial/capture/transforms.json")

    def killed(name: str, words: list[str], code: int) -> None:
        half.parent.mkdir(parents=True, exist_ok=True)
        half.write_text('{"frames": [{}, {}')

    write, commands.write = commands.write, killed  # type: ignore[method-assign]
    assert run("photos", "-o", "out") == 137
    assert not Path("out/capture").exists()
    commands.write = write  # type: ignore[method-assign]
    commands.codes.clear()
    assert run("photos", "-o", "out") == 0
    assert commands.names == ["ns-process-data"] * 2 + STEPS
    assert not half.parent.exists()


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


def test_photos_are_judged_before_anything_starts(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo("photos/x.png")
    assert "photos/x.png cannot be read (it is a pipe" in refusal(capsys, "photos", "-o", "out")
    assert commands.ran == []
    assert not Path("out").exists()
    Path("photos/x.png").unlink()
    assert run("photos", "-o", "out") == 0
    # Photos are of no more use once there are poses.
    shutil.rmtree("photos")
    Path("photos").mkdir()
    assert run("photos", "-o", "out") == 0


def test_names_with_a_dash_are_no_options(commands: Commands) -> None:
    shutil.copytree("photos", "-photos")
    assert run("./-photos", "-o", "./-out") == 0
    for words in commands.ran[1:]:
        paths = [one for one in words if "photos" in one or "out" in one.replace("--out", "")]
        assert paths
        assert all(one.startswith(("./-", "--experiment-name=")) for one in paths), words
    commands.ran.clear()
    assert run("./-out/capture", "-o", "./-again", "--keep", "0.5") == 0
    assert commands.option("--data", 0) == "./-out/capture"


def test_photos_keep_their_order_under_plain_names(commands: Commands) -> None:
    for name in ("-x.jpeg", "$(touch PWNED).JPG"):
        photo(Path("photos", name))
    seen: list[str] = []
    write = commands.write

    def watch(name: str, words: list[str], code: int) -> None:
        if name == "ns-process-data":
            folder = Path("out/capture.partial/photos")
            seen.extend(f"{path.name} {path.resolve().name}" for path in sorted(folder.iterdir()))
        write(name, words, code)

    commands.write = watch  # type: ignore[method-assign]
    assert run("photos", "-o", "out") == 0
    assert seen[:3] == ["00001.jpg $(touch PWNED).JPG", "00002.jpg -x.jpeg", "00003.jpg 0.JPG"]
