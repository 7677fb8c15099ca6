"""Scenes as files."""

from __future__ import annotations

from pathlib import Path

from sundae_ns.api.opening import load
from sundae_ns.api.page import write_page
from sundae_ns.api.scene import Scene
from sundae_ns.errors import ConfigError, writing
from sundae_ns.storage.atomic import replacing
from sundae_ns.storage.kinds import kind_of
from sundae_ns.storage.viewers import FORMATS, ViewerFile, write_for_viewers

SUFFIXES = (*FORMATS, ".sundae", ".html")
"""Suffixes of the files that :func:`save` writes."""


def save(scene: Scene, path: Path | str, *, upright: bool = False) -> None:
    """Write a scene in the format of the file's suffix, atomically; an existing file is replaced.

    ``.sundae`` holds everything that a render needs, quantised. ``.html`` is a web page that renders it. ``.ply``
    and ``.glb`` (exact), ``.spz`` and ``.sog`` (quantised) hold base colours only, for other viewers.

    Args:
        scene: any device.
        path: file to write; a missing folder of it is made.
        upright: turn from nerfstudio's z-up axes to the -y-up axes of viewers; ``.ply``, ``.spz`` and ``.sog`` only. A
            ``.glb`` is upright in any case.

    Raises:
        ConfigError: the suffix is not supported, or the format is not turned.
        DataError, PackError: the format cannot store the scene.
        StorageError: the disk is full or not writable.

    >>> import pathlib, tempfile, torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(50, 3), torch.rand(50, 3))
    >>> path = pathlib.Path(tempfile.mkdtemp(), "cloud.sundae")
    >>> sn.save(scene, path)
    >>> sn.load(path).num_primitives
    50
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ConfigError(f"{path} has no supported suffix; name it {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}")
    if upright and suffix not in FORMATS:
        raise ConfigError(f"{suffix} files keep their coordinates; leave out upright")
    with writing(f"cannot write {path}"):
        if suffix in FORMATS:
            save_for_viewers(scene, path, upright=upright)
        elif suffix == ".html":
            write_page(path, scene, packed_bytes(scene), title=path.resolve().stem)
        else:
            packed = packed_bytes(scene)
            with replacing(path) as partial:
                partial.write_bytes(packed)


def packed_file(path: Path) -> tuple[Scene, bytes]:
    """A scene and the bytes of its packed file; a file that is not packed is packed with default settings."""
    scene = load(path)
    if kind_of(path) == "packed":
        return scene, path.read_bytes()
    return scene, packed_bytes(scene)


def packed_bytes(scene: Scene) -> bytes:
    """The packed file of a scene, with default settings."""
    from sundae_ns.api.packing import contents_of  # its encoder needs a compiler, which other files do not
    from sundae_ns.storage.pack import fit_scene, pack_bytes

    return pack_bytes(*fit_scene(contents_of(scene)))[0]


def save_for_viewers(scene: Scene, path: Path, *, upright: bool = False) -> ViewerFile:
    """Write base colours in a format of other viewers; returns what was left out or clamped. See :func:`save`."""
    return write_for_viewers(
        path,
        scene.field,
        antialiased=scene.antialiased,
        upright=upright,
        in_model_frame=scene.in_model_frame,
    )
