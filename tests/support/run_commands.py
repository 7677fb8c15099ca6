"""``sundae run`` with commands that write what the real ones write last."""

from __future__ import annotations

import json
import shlex
import zipfile
from functools import cache, partial
from pathlib import Path

import command_line
import cv2
import numpy as np
import pytest
import torch
import tyro
from nerfstudio.engine.trainer import TrainerConfig
from photos import photo

from sundae_ns import method_configs
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene, pack_bytes
from sundae_ns.scene.scene import from_points

PHOTOS = 8
STEPS = ["sundae poses", "ns-train", "sundae pack", "sundae compare", "sundae export"]
NASTY = """-a b'c"d$(touch PWNED)`touch PWNED`;touch PWNED&"""
"""A name that a shell or a reader of options would take for something else."""
NAMES = ["camera poses", "train", "pack", "report", "web page"]
run = partial(command_line.run, "run")


class Commands:
    """Stands for the commands: each writes what the real one writes last, and can be told to end otherwise."""

    def __init__(self) -> None:
        self.ran: list[list[str]] = []
        self.codes: dict[str, int] = {}
        """Exit codes by names; ``--finetune`` is that of a pack with it."""
        self.placed = PHOTOS
        self.saved_at = {0: 99, 130: 39}
        """Step of the checkpoint, by the exit code of the training."""
        self.silent = False
        self.gpu = False
        self.length = 100
        """Of a training, in steps."""

    def __call__(self, words: list[str], log: Path | None = None) -> int:
        print(shlex.join(words))
        self.ran.append(list(words))
        name = self.names[-1]
        code = self.codes.get("--finetune" if "--finetune" in words else name, 0)
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

    def run_folder(self, place: int = -1) -> Path:
        """Of a training."""
        name = "--experiment-name" if "--experiment-name" in " ".join(self.ran[place]) else "--data"
        root, experiment, stamp = (self.option(each, place) for each in ("--output-dir", name, "--timestamp"))
        return Path(root, experiment, self.ran[place][1], stamp)

    def write(self, name: str, words: list[str], code: int) -> None:
        if name == "ns-train":
            write_run(self.run_folder(), self.saved_at.get(code), self.length)
        elif code:
            return
        elif name == "sundae poses":
            capture = Path(self.option("-o"))
            (capture / "images").mkdir(parents=True)
            names = [f"{index}.JPG" for index in range(PHOTOS)]
            for one in names[: self.placed]:
                photo(capture / "images" / one)
            frames = [{"file_path": f"images/{one}", "original": one} for one in names[: self.placed]]
            (capture / "transforms.json").write_text(json.dumps({"frames": frames, "left_out": names[self.placed :]}))
        elif name == "sundae pack":
            Path(self.option("-o")).write_bytes(packed())
        elif name == "sundae export":
            Path(self.option("-o")).write_text("<html><body>a scene</body></html>\n")
        else:
            folder = Path(self.option("-o"))
            folder.mkdir(exist_ok=True)
            (folder / "report.html").write_text("<html><body>a report</body></html>\n")
            figures = {"psnr": 30.0, "lpips": None}
            (folder / "report.json").write_text(json.dumps([{"configurations": [{"mean": figures}]}]))


def write_run(
    folder: Path, step: int | None, length: int = 100, *, capture: Path | None = None, source: Path | None = None
) -> Path:
    """Write a run of a capture, resumed from a source, with a checkpoint of a step."""
    (folder / "nerfstudio_models").mkdir(parents=True, exist_ok=True)
    text = f"!!python/object:sundae_ns.plugin.trainer.SundaeTrainerConfig\nschedule_length: {length}\n"
    for name, path in (("data", capture), ("load_dir", source)):
        if path is not None:
            parts = "".join(f"- {part}\n" for part in path.absolute().parts)
            text += f"{name}: !!python/object/apply:pathlib.PosixPath\n{parts}"
    (folder / "config.yml").write_text(text)
    if step is not None:
        with zipfile.ZipFile(folder / "nerfstudio_models" / f"step-{step:09d}.ckpt", "w") as archive:
            archive.writestr("data.pkl", bytes(500))
    return folder


@cache
def packed() -> bytes:
    points = torch.linspace(0, 1, 30).reshape(10, 3)
    model = {"sh_degree": 0, "rasterize_mode": "classic", "background_color": "black"}
    scene = PackedScene(from_points(points, points, sh_degree=0), meta={"model": model})
    return pack_bytes(*fit_scene(scene))[0]


def refusal(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    return command_line.refusal(capsys, "run", *words)


def write_video(path: Path, frames: int, size: tuple[int, int] = (64, 48)) -> None:
    """Write a video of frames that a square crosses; every third frame is sharp, the others are blurred."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 25, size)
    for index in range(frames):
        frame = np.full((size[1], size[0], 3), 60, np.uint8)
        frame[10:30, index % 40 : index % 40 + 20] = (40, 200, 250)
        writer.write(frame if index % 3 == 1 else cv2.GaussianBlur(frame, (9, 9), 4))
    writer.release()


def config_of(words: list[str], method: str = "sundae") -> TrainerConfig:
    """The options that ns-train reads from the words of a method and its options."""
    usual = getattr(method_configs, method.replace("-", "_")).config
    return tyro.cli(type(usual), default=usual, args=words[2:])
