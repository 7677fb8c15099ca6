"""``sundae run``: from photos to a packed scene and its report, each step a command of its own."""

from __future__ import annotations

import json
import math
import os
import shlex
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Literal, NamedTuple

import torch

from sundae_ns.cli.options import Hidden, Input, Out, Plain, word, words_of
from sundae_ns.cli.poses import PoseOptions, check_poses
from sundae_ns.cli.process import run_command
from sundae_ns.cli.refusals import check_folder
from sundae_ns.cli.train import TrainOptions, pack_run
from sundae_ns.core.errors import STOPPED, ConfigError, DataError, StorageError, SundaeError
from sundae_ns.core.files import put_aside, write_text
from sundae_ns.data.capture_files import placed_in
from sundae_ns.data.layouts import CAMERA_FILES, is_model, is_posed, no_transforms, posed_layout
from sundae_ns.io.config_file import schedule_length
from sundae_ns.io.pack.config import tuned_steps
from sundae_ns.io.pack.container import read_header, read_sections
from sundae_ns.io.run_folder import LOCK, reserve, steps_left

SETTINGS = "run.json"  # file with the settings of the first command; a repeated one must share them
DRAFT_STEPS = 3000


class Step(NamedTuple):
    """A part of the work, and how to know that it is done."""

    name: str
    run: Callable[[], int]  # Returns the exit code of its commands
    check: Callable[[], object]  # Raises an error, or returns False, unless the result is whole
    result: Path | None = None  # Out of date once an earlier step has run again


@dataclass(frozen=True)
class Project:
    """The options of ``sundae run``, and the files and steps that follow from them."""

    photos: Input  # folder of photos, a video, or a capture, which has poses already
    out: Out  # folder for the capture, the run, scene.sundae, scene.html and the report; created if missing
    quality: Literal["draft", "normal", "best"] = "normal"
    """draft trains 3,000 steps; best loses less to a smaller size (pruning.max-drop 0.03)."""
    train: Plain[TrainOptions] = TrainOptions()
    poses: Plain[PoseOptions] = PoseOptions()
    more: Hidden[tuple[str, ...]] = ()  # options of ns-train

    @cached_property
    def posed(self) -> bool:
        """Whether the photos have poses already."""
        return is_posed(self.photos)

    @property
    def capture(self) -> Path:
        """Folder with images and poses."""
        return self.photos if self.posed else self.out / "capture"

    @property
    def run(self) -> Path:
        """Folder of the training, as ns-train names it; reports name the scene by its grandparent."""
        path = (self.photos.parent if self.photos.suffix == ".json" else self.photos).resolve()
        return self.out / "runs" / (path.stem if path.is_file() else path.name) / self.train.method / "run"

    @cached_property
    def tunes(self) -> bool:
        """Whether the pack is fine-tuned, which takes seconds on a GPU."""
        return self.quality != "draft" and torch.cuda.is_available() and not self.train.cleans

    def check(self) -> None:
        """Raise an error for photos that cannot be used, and for options that contradict each other."""
        method, path = self.train.method, self.photos
        if not self.posed and (path.suffix.lower() in CAMERA_FILES or (path / "sparse").is_dir() or is_model(path)):
            raise no_transforms(path)  # says how to use a capture in another layout
        self.train.check(self.photos)
        if self.posed and self.poses.masks is not None:
            self.train.words(self.photos, self.out, masks=self.poses.masks)  # refuses wrong ones
        if self.quality == "draft" and (self.train.steps is not None or method == "sundae-tiny"):
            raise ConfigError(f"a draft has {DRAFT_STEPS:,} steps, and sundae-tiny fewer; leave out --quality")
        if self.quality == "best" and (self.train.keep, self.train.count, method) != (None, None, "sundae"):
            raise ConfigError("--quality best needs a method that decides; leave out --keep, --count and --method")
        if self.posed and (layout := posed_layout(self.photos)) is not None:
            print(f"# capture in {layout.description}", flush=True)

    def plan(self) -> list[Step]:
        """The steps in their order; a capture needs no poses."""
        packed, report, page = (self.out / name for name in ("scene.sundae", "report/report.html", "scene.html"))
        data = ("--data", word(self.capture))
        compared = [word(self.run), *([] if self.train.crop else [word(packed)])]  # photos show what a box leaves out
        measure = ["sundae", "compare", *compared, *data, "-o", word(report.parent), "--overwrite"]
        export = ["sundae", "export", word(packed), "-o", word(page)]
        pack = partial(pack_run, self.run, packed, *data, *self.train.pack_words, finetune=self.tunes)
        rest = [
            Step("train", self._train, self._trained),
            Step("pack", pack, lambda: read_sections(packed, read_header(packed)), packed),
            Step("report", lambda: run_command(measure), lambda: _check_report(report), report),
            Step("web page", lambda: run_command(export), lambda: _check_page(page), page),
        ]
        return rest if self.posed else [Step("camera poses", self._find_poses, lambda: placed_in(self.capture)), *rest]

    def _find_poses(self) -> int:
        put_aside(self.capture)  # damaged
        options = words_of(self.poses, *vars(self.poses))
        return run_command(["sundae", "poses", word(self.photos), "-o", word(self.capture), *options])

    def _train(self) -> int:
        """Train, or resume a training; ``DataError`` if too few photos have a pose."""
        if not self.posed and not (placed := placed_in(self.capture)).enough:
            counts = f"COLMAP placed {len(placed.placed)} of {placed.total} photos"
            other = f"train on these with `sundae run {shlex.quote(word(self.capture))} -o OTHER`"
            raise DataError(f"{counts}; {placed.again}, and start in another folder, or {other}")
        # The name may begin with a dash.
        more = [*self.more, f"--experiment-name={self.run.parent.parent.name}", "--timestamp", self.run.name]
        more += ["--vis", "viewer+tensorboard", "--viewer.websocket-host", "127.0.0.1"]
        saved = self.run / "nerfstudio_models"
        options = self.train
        if steps_left(self.run) is not None:
            more += ["--load-dir", word(saved)]
            options = replace(options, steps=None)
        else:
            if any(saved.glob("*.ckpt")):
                put_aside(self.run)
            if self.quality == "draft":
                options = replace(options, steps=DRAFT_STEPS)
            if self.quality == "best":
                more += ["--pipeline.model.pruning.max-drop", "0.03"]
        masks = self.poses.masks if self.posed else None
        words = options.words(self.capture, self.out / "runs", more, tunes=self.tunes, masks=masks)
        return run_command(words, self.out / "train.log")

    def _trained(self) -> bool:
        """Whether the last step is saved, of those before the pack's fine-tune."""
        left, config = steps_left(self.run), self.run / "config.yml"
        return left is not None and left <= (tuned_steps(schedule_length(config)) if self.tunes else 0)

    def claim(self) -> None:
        """Make the folder and lock it, or check that an earlier command with the same settings made it."""
        path = self.out / SETTINGS
        given = {"photos": self.photos, "quality": self.quality, **asdict(self.train), **asdict(self.poses)}
        settings = json.loads(json.dumps(given, default=lambda path: str(path.resolve())))
        settings |= settings.pop("advanced")
        # An earlier command may have been killed after it made the lock.
        begun = self.out.is_dir() and all(name.startswith((LOCK, SETTINGS)) for name in os.listdir(self.out))
        check_folder(self.out, reads=[self.photos], outside=self.photos, overwrite=begun or path.is_file() or None)
        reserve(self.out, "works in {}; wait for it, or choose another folder")
        # Only the pack reads these, and refuses a wrong one after the whole training.
        free = () if (self.out / "scene.sundae").is_file() else ("up", "start_view")
        try:
            before = json.loads(path.read_bytes()) if path.is_file() else settings
            changed = [name for name, now in settings.items() if before[name] != now and name not in free]
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise StorageError(f"{path} is damaged; choose another folder") from error
        for name in changed:
            first, now = ("left out" if each[name] is None else each[name] for each in (before, settings))
            made = f"{self.out} was made with {name.replace('_', '-')} {first}, not {now}"
            raise ConfigError(f"{made}; repeat the first command, or choose another folder")
        write_text(path, json.dumps(settings, indent=1) + "\n")


def run(project: Plain[Project]) -> int:
    """Turn photos or a video into a packed scene: find camera poses, train, pack, write a report and a page.

    Each step prints the command that it runs. The same command again skips the steps that are done, and resumes an
    interrupted training.
    """
    project.check()
    if not project.posed and not _passes(lambda: placed_in(project.capture)):
        check_poses(project.photos, project.poses, remarks=False)  # sundae poses prints them
    project.claim()
    return carry_out(project)


def carry_out(project: Project) -> int:
    """Take the steps of a project that are not done; the exit code."""
    plan = project.plan()
    for number, step in enumerate(plan, start=1):
        heading = f"# step {number} of {len(plan)}, {step.name}"
        if _passes(step.check):
            print(f"{heading}: done", flush=True)
            continue
        for later in plan[number - 1 :]:
            if later.result is not None:
                later.result.unlink(missing_ok=True)
        print(f"{heading}:", flush=True)
        if code := step.run():
            end = f"{step.name} ended with {code}, as the lines above say; mend that, and the same command continues"
            if code in STOPPED:
                end = "interrupted; the same command continues here"
            elif code > 128:  # by a signal, as where memory is full
                end = f"{step.name} was killed by signal {code - 128}; the same command tries it again"
            print(f"sundae: {end}", file=sys.stderr)
            return code
        if not _passes(step.check):
            raise SundaeError(f"{step.name} ended without its result; the output above says why")
    print(f"# packed scene: {project.out / 'scene.sundae'}; report: {project.out / 'report' / 'report.html'}")
    print(f"# to look at the scene: open {project.out / 'scene.html'} in a browser, or")
    print(shlex.join(["sundae", "view", word(project.out / "scene.sundae")]))
    return 0


def _passes(check: Callable[[], object]) -> bool:
    """Whether a check of a result is true, and raises no error of ours or of files with other contents."""
    try:
        return check() is not False
    except (SundaeError, OSError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError):
        return False


def _check_report(page: Path) -> bool:
    """Whether a report has figures and a page; figures that could not be measured are null."""
    runs = json.loads(page.with_suffix(".json").read_bytes())
    figures = [value for run in runs for way in run["configurations"] for value in way["mean"].values()]
    return _check_page(page) and bool(figures) and all(value is None or math.isfinite(value) for value in figures)


def _check_page(path: Path) -> bool:
    """Whether a web page has its end; a full disk or a copy may have cut it off."""
    return path.read_bytes()[-16:].rstrip().endswith((b"</html>", b"-->"))
