"""Camera poses of a folder of photos, by nerfstudio's program, which writes names into lines of a shell.

So it runs in a working folder beside the capture, where photos and capture have plain names, and the finished capture
is renamed. A capture that is there is whole.
"""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sundae_ns.cli.process import quoted
from sundae_ns.errors import DataError, SundaeError, writing

Matching = Literal["exhaustive", "sequential", "vocab_tree"]

TRANSFORMS = "transforms.json"
LEAST_SHARE = 0.5
"""Share of the photos that COLMAP must place; where it places fewer, they overlap too little for a good scene."""


@dataclass(frozen=True)
class Poses:
    """A capture that is made of photos in two commands, each run in :attr:`folder`."""

    photos: Path
    capture: Path
    matching: Matching
    masks: Path | None = None
    """Folder of masks, one for each photo."""

    @property
    def folder(self) -> Path:
        """Folder in which the capture is made."""
        return self.capture.with_name(f"{self.capture.name}.partial")

    @property
    def found(self) -> bool:
        """Whether photos have their poses."""
        return self.done or is_capture(self.folder / "capture")

    @property
    def done(self) -> bool:
        """Whether the capture is whole, in its place."""
        return is_capture(self.capture)

    def check(self) -> None:
        """Name the photos that are left out; ``DataError`` if the others cannot be used."""
        from sundae_ns.data.masks import masks_of
        from sundae_ns.data.photos import find_photos, left_out

        photos = find_photos(self.photos)[0]
        if self.masks is not None:
            masks_of(photos, self.masks)
        for remark in left_out(self.photos, photos, masked=self.masks is not None):
            print(f"# warning: {remark}", flush=True)

    def find(self) -> list[str]:
        """Fill the working folder with the photos; the command that finds their poses.

        Raises:
            SundaeError: a program is not installed, or the photos cannot be used.
        """
        for program, purpose in (("colmap", "finds the camera poses"), ("ffmpeg", "scales the photos")):
            if shutil.which(program) is None:
                raise SundaeError(
                    f"{program} is not installed, which {purpose}; install it with `apt-get install {program}`, "
                    "or give a capture with poses"
                )
        from sundae_ns.data.photos import find_photos

        paths, suffix = find_photos(self.photos)
        photos = self.folder / "photos"
        with writing(f"cannot make {self.folder}"):
            if self.folder.exists():
                shutil.rmtree(self.folder)
            photos.mkdir(parents=True)
            for number, path in enumerate(paths, start=1):
                _link(path, photos / f"{number:05d}{suffix}")
        return self._command("--matching-method", self.matching, *([] if _colmap_uses_gpu() else ["--no-gpu"]))

    def _command(self, *options: str) -> list[str]:
        return ["ns-process-data", "images", "--data", "photos", "--output-dir", "capture", *options]

    def _models(self) -> dict[str, int]:
        """Numbers of photos of COLMAP's models, by their folders; several if it cannot join them into one."""
        from sundae_ns.data.colmap import num_images

        capture = self.folder / "capture"
        found = sorted(path.parent for path in (capture / "colmap" / "sparse").glob("*/images.bin"))
        return {path.relative_to(capture).as_posix(): num_images(path) for path in found}

    def is_largest(self) -> bool:
        """Whether the poses are those of the largest model; ns-process-data takes the first one."""
        if self.done:
            return True
        models = self._models()
        first = models.get("colmap/sparse/0")
        return first is None or first == max(models.values()) or num_placed(self.folder / "capture") != first

    def take_largest(self) -> list[str]:
        """Command that replaces the poses by those of the largest model."""
        models = self._models()
        largest = max(models, key=models.__getitem__)
        return self._command("--skip-image-processing", "--skip-colmap", "--colmap-model-path", largest)

    def finish(self) -> None:
        """Put the capture into its place.

        Raises:
            DataError: COLMAP placed too few photos.
        """
        from sundae_ns.data.masks import add_masks, masks_of
        from sundae_ns.data.photos import LEAST_PHOTOS, find_photos
        from sundae_ns.storage.atomic import flush, put_aside

        if not self.done:
            made = self.folder / "capture"
            with writing(f"cannot make {self.capture}"):
                if self.masks is not None:
                    added = add_masks(made, masks_of(find_photos(self.photos)[0], self.masks))
                    print(f"# masks: {added}", flush=True)
                flush(made / TRANSFORMS)  # written last; the system has written the other files meanwhile
                put_aside(self.capture)
                made.replace(self.capture)
        shutil.rmtree(self.folder, ignore_errors=True)
        placed, images = num_placed(self.capture), len(list((self.capture / "images").glob("*")))
        if placed < max(LEAST_PHOTOS, LEAST_SHARE * images):
            raise DataError(
                f"COLMAP placed {placed} of {images} photos; add sharp ones that overlap more, and start in another "
                f"folder, or train on these with `sundae run {quoted(self.capture)} -o OTHER`"
            )


def is_capture(folder: Path) -> bool:
    """Whether a folder has a whole ``transforms.json``, which ns-process-data writes last."""
    try:
        num_placed(folder)
    except DataError:
        return False
    return True


def num_placed(capture: Path) -> int:
    """Number of photos with a pose; ``DataError`` if ``transforms.json`` is missing or damaged."""
    from sundae_ns.data.capture import read_json

    path = capture / TRANSFORMS
    frames = read_json(path).get("frames")
    if not isinstance(frames, list):
        raise DataError(f"{path} lists no frames; remove it to make it again")
    return len(frames)


def _link(path: Path, link: Path) -> None:
    """Make a link to a photo, or a copy on a disk without links."""
    try:
        link.symlink_to(path.absolute())
    except PermissionError:
        shutil.copyfile(path, link)


def _colmap_uses_gpu() -> bool:
    """Whether COLMAP was built with CUDA, and an NVIDIA driver is here; otherwise its GPU code asks for a display."""
    text = subprocess.run(["colmap", "-h"], capture_output=True, text=True, check=False, errors="replace").stdout
    return "with CUDA" in text and shutil.which("nvidia-smi") is not None
