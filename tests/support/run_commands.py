"""``sundae run`` with commands that write what the real ones write last."""

from __future__ import annotations

import json
import shutil
import struct
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from sundae_ns.cli import main
from sundae_ns.cli.forecast import Forecast
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
