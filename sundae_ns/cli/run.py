"""``sundae run``: from photos to a packed scene and its report, each step a command of its own."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sundae_ns.cli.outputs import check_folder
from sundae_ns.cli.process import run_in_group
from sundae_ns.cli.train import command
from sundae_ns.errors import STOPPED, ConfigError, DataError, StorageError, SundaeError, writing

Matching = Literal["exhaustive", "sequential", "vocab_tree"]

SETTINGS = "run.json"
"""File with the settings of the first command; a repeated one must share them."""
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".cr2")
"""Photos that ns-process-data reads."""
LEAST_SHARE = 0.5
"""Share of the photos that COLMAP must place; where it places fewer, they overlap too little for a good scene."""
LEAST_VIEWS = 3
"""Number of photos that it must place, because nerfstudio holds out at least one for test."""


@dataclass(frozen=True)
class Step:
    """A command, and how to know that it is done."""

    name: str
    words: Callable[[], list[str]]
    """Makes the command when it is due, because an interrupted one may have left something to resume."""
    done: Callable[[], bool]
    result: Path | None = None
    """File that is out of date once an earlier step has run again."""
    check: Callable[[], None] = lambda: None
    """Raises an error if later steps cannot use the result."""


@dataclass(frozen=True)
class Project:
    """The files of ``sundae run`` and the choices of its user."""

    photos: Path
    """Folder of photos, or a capture."""
    out: Path
    method: str
    keep: float | None
    steps: int | None
    matching: Matching

    @property
    def capture(self) -> Path:
        """Folder with images and poses."""
        return self.photos if (self.photos / "transforms.json").is_file() else self.out / "capture"

    @property
    def run(self) -> Path:
        """Folder of the training, as ns-train names it."""
        return self.out / "runs" / self.name / self.method / "run"

    @property
    def name(self) -> str:
        """Name of the scene in reports."""
        return self.photos.resolve().name

    def plan(self) -> list[Step]:
        """The steps in their order; a capture needs no poses."""
        evaluated, packed, page = self.out / "eval.json", self.out / "scene.sundae", self.out / "report" / "report.md"
        web, config, data = self.out / "scene.html", self.run / "config.yml", ("--data", self.capture)

        def step(name: str, result: Path, *words: object) -> Step:
            return Step(name, lambda: list(map(str, words)), result.is_file, result)

        steps = [
            Step("train", self.train, self.trained),
            step("evaluate", evaluated, "ns-eval", "--load-config", config, "--output-path", evaluated),
            step("pack", packed, "sundae", "pack", self.run, "-o", packed, *data),
            step("report", page, "sundae", "report", self.run, packed, *data, "-o", page.parent, "--overwrite"),
            step("web page", web, "sundae", "export", packed, "-o", web),
        ]
        if self.capture != self.photos:
            posed = self.capture / "transforms.json"
            steps[:0] = [
                Step("camera poses", self.poses, posed.is_file),
                Step("largest model", self.poses_of_largest, self.is_largest, check=self.check_poses),
            ]
        return steps

    def poses(self) -> list[str]:
        """Command that finds the camera poses.

        Raises:
            SundaeError: it needs a program that is not installed.
        """
        for program, purpose in (("colmap", "finds the camera poses"), ("ffmpeg", "scales the photos")):
            if shutil.which(program) is None:
                raise SundaeError(
                    f"{program} is not installed, which {purpose}; install it with `apt-get install {program}`, "
                    "or give a capture with poses"
                )
        return self.process_photos("--matching-method", self.matching, *([] if _colmap_uses_gpu() else ["--no-gpu"]))

    def process_photos(self, *options: str) -> list[str]:
        """Command that makes the capture of the photos, with further options."""
        words = ["ns-process-data", "images", "--data", str(self.photos), "--output-dir", str(self.capture)]
        return [*words, *options]

    def models(self) -> dict[str, int]:
        """Numbers of photos of COLMAP's models, by their folders; several if it cannot join them into one."""
        from sundae_ns.data.colmap import num_images

        found = sorted(path.parent for path in (self.capture / "colmap" / "sparse").glob("*/images.bin"))
        return {path.relative_to(self.capture).as_posix(): num_images(path) for path in found}

    def is_largest(self) -> bool:
        """Whether the poses are those of the largest model; ns-process-data takes the first one."""
        models = self.models()
        first = models.get("colmap/sparse/0")
        return first is None or first == max(models.values()) or self.placed() != first

    def poses_of_largest(self) -> list[str]:
        """Command that replaces the poses by those of the largest model."""
        models = self.models()
        largest = max(models, key=models.__getitem__)
        return self.process_photos("--skip-image-processing", "--skip-colmap", "--colmap-model-path", largest)

    def placed(self) -> int:
        """Number of photos with a pose."""
        from sundae_ns.data.capture import read_json

        return len(read_json(self.capture / "transforms.json").get("frames", []))

    def check_poses(self) -> None:
        """Raise ``DataError`` if COLMAP placed too few photos."""
        placed = self.placed()
        images = len(list((self.capture / "images").iterdir()))
        if placed < max(LEAST_VIEWS, LEAST_SHARE * images):
            raise DataError(
                f"COLMAP placed {placed} of {images} photos; add sharp ones that overlap more, and start in another "
                f"folder, or train on these with `sundae run {shlex.quote(str(self.capture))} -o OTHER`"
            )

    def train(self) -> list[str]:
        """Command that trains, or resumes a training."""
        saved = self.run / "nerfstudio_models"
        resumes = any(saved.glob("step-*.ckpt"))
        # Without a number of steps, a resumed run trains those that are left.
        words = command(self.capture, self.out / "runs", self.method, self.keep, None if resumes else self.steps)
        # Curves of the report come from tensorboard's files.
        words += ["--experiment-name", self.name, "--timestamp", self.run.name, "--vis", "viewer+tensorboard"]
        return [*words, "--load-dir", str(saved)] if resumes else words

    def trained(self) -> bool:
        """Whether the last step of the schedule is saved."""
        from sundae_ns.storage.runs.checkpoint import newest_step
        from sundae_ns.storage.runs.config_file import schedule_length

        step = newest_step(self.run)
        return step is not None and step + 1 >= schedule_length(self.run / "config.yml")

    def claim(self) -> None:
        """Make the folder, or check that an earlier command with the same settings made it.

        Raises:
            ConfigError: its settings were others.
            StorageError: the folder holds other files, or cannot be written.
        """
        settings = {**asdict(self), "photos": str(self.photos.resolve())}
        del settings["out"]
        path = self.out / SETTINGS
        if self.out.resolve().is_relative_to(self.photos.resolve()):
            raise StorageError(f"{self.out} lies in {self.photos}, which the command reads; choose another folder")
        check_folder(self.out, reads=[self.photos], overwrite=path.is_file())
        if not path.is_file():
            from sundae_ns.storage.atomic import write_text

            with writing(f"cannot make {self.out}"):
                self.out.mkdir(parents=True, exist_ok=True)
            write_text(path, json.dumps(settings, indent=1) + "\n")
            return
        try:
            before = dict(json.loads(path.read_bytes()).items())
        except (ValueError, AttributeError) as error:
            raise StorageError(f"{path} is damaged; choose another folder") from error
        for name, value in settings.items():
            if before.get(name) != value:
                first, now = ("left out" if each is None else each for each in (before.get(name), value))
                raise ConfigError(
                    f"{self.out} was made with {name} {first}, not {now}; "
                    "repeat the first command, or choose another folder"
                )


def run(
    photos: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    method: str = "sundae",
    keep: float | None = None,
    steps: int | None = None,
    matching: Matching = "exhaustive",
) -> int:
    """Turn photos into a packed scene: find camera poses, train, evaluate, pack, and write a report and a web page.

    Each step prints the command that it runs. The same command again skips the steps that are done, and resumes an
    interrupted training.

    Args:
        photos: folder of photos, or a capture, which has poses already.
        out: folder for the capture, the run, eval.json, scene.sundae, scene.html and the report; created if missing.
        method: as of sundae train; sundae-tiny suits small images and a CPU.
        keep: share of the primitives to keep, in (0, 1]; by default that of the method.
        steps: number of training steps; by default that of the method.
        matching: photos that COLMAP compares: all pairs, neighbours by name (for frames of a video), or similar ones
            (for thousands of photos; downloads a vocabulary).
    """
    _check_photos(photos)
    command(photos, out, method, keep, steps)  # refuses numbers out of range before the first step
    project = Project(photos, out, method, keep, steps, matching)
    project.claim()
    plan = project.plan()
    for number, step in enumerate(plan, start=1):
        heading = f"# step {number} of {len(plan)}, {step.name}"
        if step.done():
            print(f"{heading}: done", flush=True)
        else:
            words = step.words()
            for later in plan[number - 1 :]:
                if later.result is not None:
                    later.result.unlink(missing_ok=True)
            print(f"{heading}:\n{shlex.join(words)}", flush=True)
            code = run_in_group(words)
            if code in STOPPED:
                print("sundae: interrupted; the same command continues here", file=sys.stderr)
                return code
            if code:
                print(f"sundae: {step.name} ended with {code}; the same command tries it again", file=sys.stderr)
                return code
            if not step.done():
                raise SundaeError(f"{words[0]} ended without its result; the output above says why")
        step.check()
    print(f"# packed scene: {out / 'scene.sundae'}; report: {out / 'report' / 'report.md'}")
    print(f"# to look at the scene: open {out / 'scene.html'} in a browser, or")
    print(shlex.join(["ns-viewer", "--load-config", str(project.run / "config.yml")]))
    return 0


def _check_photos(photos: Path) -> None:
    """Raise ``DataError`` unless the path is a capture or a folder with photos."""
    from sundae_ns.data.capture import no_transforms

    if not photos.exists():
        raise DataError(f"{photos} does not exist; give a folder of photos, or a capture")
    if (photos / "transforms.json").is_file():
        return
    if photos.is_file() or (photos / "sparse").is_dir():
        raise no_transforms(photos)  # says how to use a video, or a capture in COLMAP layout
    if not any(path.suffix.lower() in SUFFIXES for path in photos.rglob("*")):
        raise DataError(f"{photos} holds no photos ({', '.join(SUFFIXES)}); give a folder of photos, or a capture")


def _colmap_uses_gpu() -> bool:
    """Whether COLMAP was built with CUDA, and an NVIDIA driver is here; otherwise its GPU code asks for a display."""
    text = subprocess.run(["colmap", "-h"], capture_output=True, text=True, check=False, errors="replace").stdout
    return "with CUDA" in text and shutil.which("nvidia-smi") is not None
