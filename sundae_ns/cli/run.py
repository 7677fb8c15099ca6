"""``sundae run``: from photos to a packed scene and its report, each step a command of its own."""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sundae_ns.cli.forecast import measured_step, trained_size
from sundae_ns.cli.outputs import check_folder
from sundae_ns.cli.poses import FRAMES, Matching, check_poses, too_few
from sundae_ns.cli.process import run_in_group, word
from sundae_ns.cli.results import is_evaluation, is_packed, is_page, is_report
from sundae_ns.cli.train import check, command, finetune_words, has_gpu, pack_command
from sundae_ns.errors import STOPPED, ConfigError, DataError, StorageError, SundaeError, writing

SETTINGS = "run.json"
"""File with the settings of the first command; a repeated one must share them."""
TRAIN = "train"
"""Name of the step that saves itself when it is interrupted."""
Quality = Literal["draft", "normal", "best"]
QUALITIES: dict[Quality, list[str]] = {
    "draft": [],
    "normal": [],
    "best": ["--pipeline.model.pruning.max-drop", "0.03"],
}
"""Options of ns-train for each quality; a draft has fewer steps."""
DRAFT_STEPS = 3000
MEGABYTE = 1_000_000
BUSY = "works in {}; wait for it, or choose another folder"


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
    instead: Callable[[], list[str]] | None = None
    """Makes the command to try where the first one fails."""


@dataclass(frozen=True)
class Project:
    """The files of ``sundae run`` and the choices of its user."""

    photos: Path
    """Folder of photos, a video, or a capture."""
    out: Path
    method: str
    keep: float | None
    steps: int | None
    matching: Matching
    quality: Quality = "normal"
    max_mb: float | None = None
    masks: Path | None = None
    frames: int = FRAMES

    @property
    def capture(self) -> Path:
        """Folder with images and poses."""
        return self.photos if self.posed else self.out / "capture"

    @cached_property
    def posed(self) -> bool:
        """Whether the photos have poses already."""
        from sundae_ns.data.layouts import is_posed

        return is_posed(self.photos)

    @property
    def run(self) -> Path:
        """Folder of the training, as ns-train names it."""
        return self.out / "runs" / self.name / self.method / "run"

    @property
    def name(self) -> str:
        """Name of the scene in reports."""
        path = self.photos.resolve()
        return path.stem if path.is_file() else path.name

    def plan(self) -> list[Step]:
        """The steps in their order; a capture needs no poses."""
        evaluated, packed, page = self.out / "eval.json", self.out / "scene.sundae", self.out / "report" / "report.md"
        web, data = self.out / "scene.html", ("--data", self.capture)

        def step(name: str, result: Path, whole: Callable[[Path], bool], *words: object) -> Step:
            line = [word(part) if isinstance(part, Path) else str(part) for part in words]
            return Step(name, lambda: line, lambda: whole(result), result)

        report = ("sundae", "report", self.run, packed, *data, "-o", page.parent, "--overwrite")
        steps = [
            Step(TRAIN, self.train, self.trained),
            step("evaluate", evaluated, is_evaluation, "sundae", "eval", self.run, *data, "-o", evaluated),
            Step(
                *("pack", lambda: self.pack(packed), lambda: is_packed(packed), packed),
                instead=lambda: self.pack(packed, plain=True),
            ),
            step("report", page, is_report, *report),
            step("web page", web, is_page, "sundae", "export", packed, "-o", web),
        ]
        if not self.posed:
            steps.insert(0, Step("camera poses", self.find_poses, self.placed, check=self.check_poses))
        return steps

    def find_poses(self) -> list[str]:
        """Command that makes the capture."""
        from sundae_ns.storage.atomic import put_aside

        with writing(f"cannot replace {self.capture}"):
            put_aside(self.capture)  # damaged
        words = ["sundae", "poses", word(self.photos), "-o", word(self.capture)]
        words += ["--matching", self.matching] if self.matching != "auto" else []
        words += ["--frames", str(self.frames)] if self.frames != FRAMES else []
        return [*words, "--masks", word(self.masks)] if self.masks is not None else words

    def placed(self) -> bool:
        """Whether the capture is whole."""
        from sundae_ns.poses import placed_in

        try:
            placed_in(self.capture)
        except DataError:
            return False
        return True

    def check_poses(self) -> None:
        """Raise ``DataError`` if too few photos have a pose."""
        from sundae_ns.poses import placed_in

        placed = placed_in(self.capture)
        if not placed.enough:
            raise too_few(self.capture, placed)

    def train(self) -> list[str]:
        """Command that trains, or resumes a training."""
        saved, resumes = self.run / "nerfstudio_models", self._steps_left() is not None
        if not resumes and any(saved.glob("*.ckpt")):
            from sundae_ns.storage.atomic import put_aside

            with writing(f"cannot replace {self.run}"):
                put_aside(self.run)
        # Curves of the report come from tensorboard's files. The name may begin with a dash.
        more = [f"--experiment-name={self.name}", "--timestamp", self.run.name, "--vis", "viewer+tensorboard"]
        more += ["--load-dir", word(saved)] if resumes else []
        more += finetune_words() if self.tunes else []
        if not resumes:
            more += self.options
        # Without a number of steps, a resumed run trains those that are left.
        steps = None if resumes else self.num_steps
        return command(self.capture, self.out / "runs", self.method, self.keep, steps, more)

    def pack(self, packed: Path, *, plain: bool = False) -> list[str]:
        """Command that packs, with a fine-tune where that takes seconds and nobody asked for a draft."""
        more = ["--data", word(self.capture)]
        more += [] if self.max_bytes is None else ["--target-bytes", str(self.max_bytes)]
        return pack_command(self.run, packed, *more, finetune=self.tunes and not plain)

    @property
    def tunes(self) -> bool:
        """Whether the pack is fine-tuned."""
        return self.quality != "draft" and has_gpu()

    @property
    def num_steps(self) -> int | None:
        """Number of training steps; None for that of the method."""
        return DRAFT_STEPS if self.quality == "draft" else self.steps

    @property
    def max_bytes(self) -> int | None:
        """Most bytes of the packed scene."""
        return None if self.max_mb is None else round(self.max_mb * MEGABYTE)

    @property
    def options(self) -> list[str]:
        """Options of ns-train for the quality and the size."""
        if self.max_bytes is None:
            return QUALITIES[self.quality]
        from sundae_ns.storage.pack import FINETUNED_SIZE

        # Trials count the bytes of packs without a fine-tune.
        most = round(self.max_bytes / FINETUNED_SIZE) if self.tunes else self.max_bytes
        return [*QUALITIES[self.quality], "--pipeline.model.pruning.max-bytes", str(most)]

    def check(self) -> None:
        """Raise ``ConfigError`` for options that contradict each other."""
        if self.max_mb is not None and not 0.01 <= self.max_mb <= 1e6:
            raise ConfigError(f"max-mb is {self.max_mb:g}; give at least 0.01")
        if self.masks is not None and self.posed:
            raise ConfigError(
                f"{self.photos} has poses already; give each frame of transforms.json its mask_path, or a COLMAP model "
                "its masks with `sundae train CAPTURE -- colmap --masks-path`"
            )
        if self.quality == "draft" and self.steps is not None:
            raise ConfigError(f"a draft has {DRAFT_STEPS:,} steps; leave out --steps or --quality")
        for name, given in (("--max-mb", self.max_mb is not None), ("--quality best", self.quality == "best")):
            if given and (self.keep is not None or self.method != "sundae"):
                raise ConfigError(
                    f"{name} needs a method that decides the number of primitives; leave out --keep and --method"
                )
        if self.quality == "draft" and self.method == "sundae-tiny":
            raise ConfigError("sundae-tiny is shorter than a draft; leave out --quality")

    def forecast(self) -> None:
        """Print how long the training takes on this machine, if it starts anew; on a CPU, with what is faster."""
        from sundae_ns.training.duration import LONG, duration

        size = None if self._steps_left() is not None else trained_size(self.photos)
        found = None if size is None else measured_step(self.method, *size)
        if size is None or found is None:
            return
        steps, cpu = self.num_steps or found.steps, found.device == "cpu"
        took = f"{'at least' if cpu else 'about'} {duration(steps * found.step_s)}"
        told = f"{steps:,} training steps take {took} on this {'CPU' if cpu else 'GPU'}"
        told += f", {1000 * found.step_s:.0f} ms each at {size[0]} x {size[1]} px"
        if not cpu or steps * found.step_s <= LONG:
            print(f"# forecast: {told}", flush=True)
            return
        faster = [] if steps <= DRAFT_STEPS else [f"--quality draft ({duration(DRAFT_STEPS * found.step_s)})"]
        faster += ["--method sundae-tiny"] if self.method != "sundae-tiny" else []
        print(f"# warning: {told}; faster are {', '.join([*faster, 'smaller photos and a GPU'])}", flush=True)

    def trained(self) -> bool:
        """Whether the last step is saved, of those before the pack's fine-tune."""
        left = self._steps_left()
        if left is None or left <= 0:
            return left is not None
        from sundae_ns.storage.config_file import schedule_length
        from sundae_ns.storage.pack import tuned_steps

        return self.tunes and left <= tuned_steps(schedule_length(self.run / "config.yml"))

    def _steps_left(self) -> int | None:
        from sundae_ns.storage.run_folder import steps_left

        return steps_left(self.run)

    def claim(self) -> int:
        """Make the folder and lock it, or check that an earlier command with the same settings made it.

        Returns:
            Descriptor of the lock.

        Raises:
            ConfigError: its settings were others.
            StorageError: another process works in the folder, it holds other files, or it cannot be written.
        """
        from sundae_ns.storage.atomic import write_text
        from sundae_ns.storage.run_folder import LOCK, reserve

        settings = {**asdict(self), "photos": str(self.photos.resolve())}
        settings["masks"] = None if self.masks is None else str(self.masks.resolve())
        del settings["out"]
        path = self.out / SETTINGS
        if self.out.resolve().is_relative_to(self.photos.resolve()):
            raise StorageError(f"{self.out} lies in {self.photos}, which the command reads; choose another folder")
        # An earlier command may have been killed after it made the lock.
        begun = self.out.is_dir() and all(name.startswith((LOCK, SETTINGS)) for name in os.listdir(self.out))
        check_folder(self.out, reads=[self.photos], overwrite=begun or path.is_file())
        with writing(f"cannot make {self.out}"):
            self.out.mkdir(parents=True, exist_ok=True)
        lock = reserve(self.out, BUSY)
        if not path.is_file():
            write_text(path, json.dumps(settings, indent=1) + "\n")
            return lock
        try:
            before = {"quality": "normal", **json.loads(path.read_bytes())}
            if "frames" not in before:  # of an earlier version, which compared all pairs by default
                usual = {"exhaustive": "auto"}.get(before["matching"], before["matching"])
                before |= {"frames": FRAMES, "matching": usual}
        except (KeyError, ValueError, TypeError) as error:
            raise StorageError(f"{path} is damaged; choose another folder") from error
        for name, value in settings.items():
            if before.get(name) != value:
                first, now = ("left out" if each is None else each for each in (before.get(name), value))
                raise ConfigError(
                    f"{self.out} was made with {name} {first}, not {now}; "
                    "repeat the first command, or choose another folder"
                )
        return lock


def run(
    photos: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    method: str = "sundae",
    keep: float | None = None,
    steps: int | None = None,
    matching: Matching = "auto",
    quality: Quality = "normal",
    max_mb: float | None = None,
    masks: Path | None = None,
    frames: int = FRAMES,
) -> int:
    """Turn photos or a video into a packed scene: find camera poses, train, evaluate, pack, write a report and a page.

    Each step prints the command that it runs. The same command again skips the steps that are done, and resumes an
    interrupted training.

    Args:
        photos: folder of photos, a video, or a capture, which has poses already.
        out: folder for the capture, the run, eval.json, scene.sundae, scene.html and the report; created if missing.
        method: as of sundae train; sundae-tiny suits small images and a CPU.
        keep: share of the primitives to keep, in (0, 1]; by default that of the method.
        steps: number of training steps; by default that of the method.
        matching: as of sundae poses; photos that are compared to find their poses.
        quality: draft trains 3,000 steps; best loses less to a smaller size (pruning.max-drop 0.03).
        max_mb: most megabytes of the packed scene; fewer primitives and coarser steps keep to it.
        masks: folder with a mask for each photo, under its name; training leaves out what is black. By default one
            named masks beside the photos.
        frames: number of frames of a video; the sharpest of each stretch.
    """
    _check_input(photos)
    check(photos, method, keep, steps)
    project = Project(photos, out, method, keep, steps, matching, quality, max_mb, masks, frames)
    project.check()
    if not project.posed and not project.placed():
        check_poses(photos, frames, masks, remarks=False)  # sundae poses prints them
    lock = project.claim()
    project.forecast()
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
            code = run_in_group(words, locks=[lock], saves=step.name == TRAIN)
            other = step.instead() if code and code not in STOPPED and step.instead is not None else words
            if other != words:
                words = other
                print(f"{heading}, after the fine-tune ended with {code}:\n{shlex.join(words)}", flush=True)
                code = run_in_group(words, locks=[lock], saves=False)
            if code in STOPPED:
                print("sundae: interrupted; the same command continues here", file=sys.stderr)
                return code
            if code:
                print(f"sundae: {step.name} ended with {code}; the same command tries it again", file=sys.stderr)
                return code
            if not step.done():
                raise SundaeError(f"{words[0]} ended without its result; the output above says why")
        step.check()
    print(f"# packed scene: {out / 'scene.sundae'}; report: {out / 'report' / 'report.html'}")
    print(f"# to look at the scene: open {out / 'scene.html'} in a browser, or")
    print(shlex.join(["sundae", "view", word(out / "scene.sundae")]))
    return 0


def _check_input(photos: Path) -> None:
    """Raise ``DataError`` for a path that is neither a capture nor a folder that may hold photos, or a video."""
    from sundae_ns.data.layouts import is_model, is_posed, no_transforms, posed_layout

    if not photos.exists():
        raise DataError(f"{photos} does not exist; give a folder of photos, a video, or a capture")
    if is_posed(photos):
        layout = posed_layout(photos)
        if layout is not None:
            print(f"# capture in {layout.program} layout: {layout.description}", flush=True)
        return
    if (photos / "sparse").is_dir() or is_model(photos):
        raise no_transforms(photos)  # says how to use a capture in another layout
