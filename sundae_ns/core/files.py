"""Atomic writes: a file is written under another name, flushed to disk, and renamed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from fractions import Fraction
from glob import escape
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from filelock import lock_descriptor

from sundae_ns.core.errors import writing

if TYPE_CHECKING:
    from PIL import Image

PARTIAL = ".partial"  # suffix of files that are not complete yet
_WINDOWS = os.name == "nt"  # renames no open file, opens no folder, and flushes only what it may write


def at_home(path: Path | str) -> Path:
    """A path as a user gives it; ``~`` at its beginning becomes the home folder, as in a shell."""
    return Path(os.path.expanduser(path))


def locked(file: IO[Any]) -> bool | None:
    """Whether this process gets the lock of an open file until it ends; None if the file system has no locks."""
    with suppress(OSError):
        return lock_descriptor(file.fileno(), blocking=False)
    return None


@contextmanager
def replacing(path: Path, partial: Path | None = None) -> Iterator[Path]:
    """Yield a path to write to; after the block, flush that file to disk and rename it to ``path``.

    After a kill or a power cut, ``path`` is either the earlier file or the complete new one. If the block raises, its
    file is removed and ``path`` is unchanged. A missing folder is made. ``partial`` is the temporary file; by default
    one of a random number, and those of killed processes are removed. ``StorageError`` if nothing can be written.
    """
    owned = partial is None and not _WINDOWS
    partial = partial or path.with_name(f"{path.name}.{int.from_bytes(os.urandom(4))}{PARTIAL}")
    try:
        with writing(f"cannot write {path}"), ExitStack() as stack:
            path.parent.mkdir(parents=True, exist_ok=True)
            if owned:
                _remove_abandoned(path)
                locked(stack.enter_context(partial.open("wb")))
            yield partial
            flush(partial)
            partial.replace(path)
            flush(path.parent)
    finally:
        with suppress(OSError):
            partial.unlink()


def _remove_abandoned(path: Path) -> None:
    """Remove partial files of killed processes, which hold no lock."""
    for other in path.parent.glob(f"{escape(path.name)}.*{PARTIAL}"):
        if other.name[len(path.name) + 1 : -len(PARTIAL)].isdigit():  # else of a file with a longer name
            with suppress(OSError), other.open("rb") as file:
                if locked(file):
                    other.unlink()


def write_files(contents: Mapping[Path, bytes]) -> None:
    """Write files that belong together: all, or none and a ``StorageError``."""
    with ExitStack() as stack:
        partials = [stack.enter_context(replacing(path)) for path in contents]
        for partial, content in zip(partials, contents.values(), strict=True):
            partial.write_bytes(content)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically; ``StorageError`` if the disk is full or not writable."""
    write_files({path: content})


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8 as :func:`write_bytes` does; bytes of a name that are no text become ``\\udcff``."""
    write_files({path: text.encode(errors="backslashreplace")})


def write_image(path: Path, image: Image.Image) -> None:
    """Write an image as :func:`write_bytes` does, in the format of its suffix."""
    kind = path.suffix.lower()[1:]
    with replacing(path) as partial:
        image.save(partial, format={"jpg": "jpeg"}.get(kind, kind))


def put_aside(path: Path) -> None:
    """Rename a damaged file or folder, if there is one, to ``NAME.damaged``; replaces an earlier one."""
    aside = path.with_name(f"{path.name}.damaged")
    if path.exists():
        if aside.is_dir():
            shutil.rmtree(aside)
        path.replace(aside)


def flush(path: Path) -> None:
    """Wait until a file, or the entries of a folder, are on the disk."""
    if _WINDOWS and path.is_dir():
        return
    handle = os.open(path, os.O_RDWR if _WINDOWS else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_video(path: Path, frames: Iterable[Image.Image], *, frames_per_second: float = 6) -> int:
    """Write RGB frames of one size with even sides as an MP4 (H.264), which browsers play; returns their number.

    PyAV brings its own encoder, so no ffmpeg is needed. The path may have any suffix.
    """
    import av

    count = -1
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        rate = Fraction(frames_per_second).limit_denominator(1001)
        stream = container.add_stream("libx264", rate=rate, options={"crf": "18"})
        stream.pix_fmt = "yuv420p"
        stream.codec_context.colorspace = 1  # BT.709; without it, players guess from the size
        for count, image in enumerate(frames):
            if count == 0:
                stream.width, stream.height = image.size
            container.mux(stream.encode(av.VideoFrame.from_image(image).reformat(format="yuv420p", dst_colorspace=1)))
        container.mux(stream.encode(None))
    return count + 1
