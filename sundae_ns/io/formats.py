"""Kinds of files, and one reader and one writer for files of Gaussians of all formats."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from sundae_ns.core.errors import CheckpointError, ConfigError, DataError, SundaeError, regular
from sundae_ns.core.gaussians import SPLAT_NAMES, Gaussians, Sanitised, sanitise, sh_degree_of
from sundae_ns.io import checkpoint
from sundae_ns.io.coordinates import similarity
from sundae_ns.io.gltf import read_glb, write_glb
from sundae_ns.io.ply import (
    MAX_SH_DEGREE,
    MODEL_FRAME,
    check_gaussians,
    is_nerfstudio_ply,
    ply_comments,
    read_ply,
    write_ply,
)
from sundae_ns.io.sog import METAS, read_sog, write_sog
from sundae_ns.io.splat import read_gsplat, read_ksplat, read_splat
from sundae_ns.io.spz import clamped, read_spz, write_spz

Kind = Literal["packed", "ply", "spz", "sog", "glb", "splat", "ksplat", "gsplat"]
PRIMITIVES: dict[Kind, str] = {
    "ply": ".ply file",
    "spz": ".spz file",
    "sog": ".sog file",
    "glb": ".glb file",
    "splat": ".splat file",
    "ksplat": ".ksplat file",
    "gsplat": "checkpoint of gsplat",
}
"""Kinds of files that hold Gaussians alone, and their names."""
FORMATS = (".ply", ".spz", ".sog", ".glb")  # that write_for_viewers writes
ANTIALIASED = "SplatRenderMode: mip"
"""Header comment of a .ply whose scene was trained with antialiasing."""
_FIRST_BYTES: dict[bytes, Kind] = {
    b"\x89SUNDAE\n": "packed",
    b"ply\n": "ply",
    b"ply\r": "ply",
    b"\x1f\x8b": "spz",
    b"NGSP": "spz",
    b"PK\x03\x04": "sog",
    b"glTF": "glb",
}
_HEADERLESS: dict[str, Kind] = {".splat": "splat", ".ksplat": "ksplat"}
_ZIPS: dict[str, Kind] = {".sog": "sog", ".zip": "sog", ".pt": "gsplat"}
_BY_SUFFIX: dict[str, Kind] = {".ply": "ply", ".spz": "spz", ".glb": "glb", **_ZIPS, **_HEADERLESS}
_UNREAD = {
    ".lcc": "is a scene of XGRIDS; convert it to .ply with SuperSplat or splat-transform",
    ".rad": "is a scene of Spark; convert the .ply that it was made of",
    ".gltf": "is a glTF scene in several files; export it as .glb",
    ".pth": "is a checkpoint of another trainer; give its .ply, such as point_cloud/iteration_*/point_cloud.ply",
}
# In nerfstudio, z points up; in a 3DGS .ply, -y does.
_UPRIGHT = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
_log = logging.getLogger(__name__)


def kind_of(path: Path) -> Kind | None:
    """Kind of the file at a path by its first bytes; None for any other file, a folder or a missing file."""
    try:
        with regular(path).open("rb") as file:
            first = file.read(max(map(len, _FIRST_BYTES)))
    except OSError:
        return None
    kind = next((kind for begin, kind in _FIRST_BYTES.items() if first.startswith(begin)), None)
    others = _ZIPS if kind == "sog" else _HEADERLESS  # a checkpoint is a zip file too
    return others.get(path.suffix.lower()) if kind in ("sog", None) else kind


def kind_of_gaussians(path: Path) -> Kind | None:
    """Kind of a file of Gaussians, of a missing or damaged one by its suffix; None for all others.

    A .sog may be a folder of images, or the ``meta.json`` in it.
    """
    if path.name in METAS or (any((path / name).is_file() for name in METAS) and not (path / "config.yml").exists()):
        return "sog"
    kind = kind_of(path)
    if kind is None and not path.is_dir():
        kind = _BY_SUFFIX.get(path.suffix.lower())
    return kind if kind in PRIMITIVES else None


def unread(path: Path) -> str | None:
    """What a scene is that this program does not read, and how to convert it; None for any other path.

    >>> unread(Path("garden.lcc"))
    'is a scene of XGRIDS; convert it to .ply with SuperSplat or splat-transform'
    """
    if path.is_dir():
        # The folder of a training by the authors of 3DGS.
        clouds = sorted(path.glob("point_cloud/iteration_*/point_cloud.ply"), key=lambda each: each.stat().st_mtime)
        return f"is a folder of 3DGS; give {clouds[-1]}" if clouds else None
    return _UNREAD.get(path.suffix.lower())


def refuse(path: Path, *, packed: str | None = None, primitives: str | None = None) -> None:
    """Raise ``CheckpointError`` for a packed scene or a file of Gaussians, with the advice for it; None accepts it."""
    kind = kind_of(path)
    if kind == "packed" and packed is not None:
        raise CheckpointError(f"{path} is a packed scene; {packed}")
    if kind in PRIMITIVES and primitives is not None:
        raise CheckpointError(f"{path} is a {PRIMITIVES[kind]}; {primitives}")
    if kind is None and (other := unread(path)) is not None:
        raise CheckpointError(f"{path} {other}")


class StoredGaussians(NamedTuple):
    """The Gaussians of a file, and what the file says of its antialiasing and coordinates."""

    sanitised: Sanitised
    """Those that have a meaning, with finite values, float32 on the CPU; and what was clamped or dropped."""
    antialiased: bool
    in_model_frame: bool


def read_gaussian_file(path: Path) -> StoredGaussians:
    """Read a file of Gaussians of any program. Nothing in it is executed.

    Raises:
        DataError: the file is missing, damaged, of another kind, or has no finite Gaussian.
    """
    antialiased = in_model_frame = False
    match kind_of_gaussians(path):
        case "glb":
            params, antialiased, in_model_frame = read_glb(path)
        case "spz":
            params, antialiased = read_spz(path)
        case "sog":
            params, antialiased = read_sog(path)
        case "splat" | "ksplat" | "gsplat" as kind:
            params = {"splat": read_splat, "ksplat": read_ksplat, "gsplat": read_gsplat}[kind](path)
        case _:
            params, antialiased = read_ply(path), ANTIALIASED in ply_comments(path)
            in_model_frame = is_nerfstudio_ply(path)
    params["means"] = params["means"].float()
    return StoredGaussians(usable(params, path, DataError, "export it again"), antialiased, in_model_frame)


def usable(
    params: Mapping[str, Tensor],
    path: Path,
    failure: type[SundaeError] = CheckpointError,
    remedy: str = "give another file",
) -> Sanitised:
    """The Gaussians of a file that have a meaning, with finite values; logs what was changed.

    Raises:
        failure: no Gaussian has a meaning.
    """
    sanitised = sanitise(params)
    if not sanitised.gaussians.num_gaussians:
        raise failure(f"{path} has {len(sanitised.mask):,} Gaussians, and none is finite; {remedy}")
    if summary := sanitised.summary():
        _log.warning("%s: %s", path, summary)
    return sanitised


def read_gaussians(path: Path) -> tuple[dict[str, Tensor], bool]:
    """Read a splatfacto or SUNDAE checkpoint, a packed scene without its head, or a file of Gaussians.

    Args:
        path: ``.ckpt`` file, a folder of them (the newest counts), or a file of Gaussians or packed scene.

    Returns:
        Finite Gaussians without features, float32 on the CPU, colours as harmonics; and whether coordinates are those
        of nerfstudio's model (checkpoints, ``ns-export``), not the capture's (others).

    Raises:
        CheckpointError: there is no such file, it holds no Gaussians, or has another format.
        PackError: the packed scene is damaged.
    """
    wanted = "give a .ckpt file, the folder of them, or a .ply"
    if not path.exists():
        raise CheckpointError(f"{path} does not exist; {wanted}")
    if kind_of_gaussians(path) is not None:
        try:
            stored = read_gaussian_file(path)
        except DataError as error:
            raise CheckpointError(str(error)) from error
        return dict(stored.sanitised.gaussians), stored.in_model_frame
    if kind_of(path) == "packed":
        from sundae_ns.io.pack.packed_scene import read_scene  # its decoder needs a compiler, which other files do not

        packed = read_scene(path)
        model, source = ((packed.meta.get(key) or {}) for key in ("model", "source"))
        logits = isinstance(model, dict) and model.get("sh_degree") == 0
        params = {name: packed.gaussians[name] for name in SPLAT_NAMES}
        in_model_frame = not isinstance(source, dict) or source.get("model_frame") is not False
        return dict(Gaussians(params, "logits" if logits else "harmonics").as_harmonics()), in_model_frame
    refuse(path)
    if not path.is_dir():
        loaded = checkpoint.read(path)
    elif checkpoint.checkpoints(checkpoint.folder_of(path)):
        path, loaded = checkpoint.read_newest(path)
    else:
        raise CheckpointError(f"{path} holds no checkpoint; {wanted}")
    return dict(usable(checkpoint.gaussians_of(loaded, path), path).gaussians.as_harmonics()), True


class ViewerFile(NamedTuple):
    """Summary of a written file."""

    primitives: int
    dropped: int
    """Gaussians left out because they are not finite."""
    degree: int
    """SH degree of the file."""
    clamped: int
    """Gaussians with values beyond the range of a .spz, which stores the nearest value."""
    cut: bool
    """Whether the scene has a higher SH degree than the file."""
    bytes: int


def check_format(path: Path) -> None:
    """Raise ``ConfigError`` unless the suffix of a file names a supported format."""
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"{path} has no supported suffix; name it {' or '.join((*FORMATS, '.html'))}")


def write_for_viewers(
    path: Path,
    params: Mapping[str, Tensor],
    *,
    antialiased: bool = False,
    upright: bool = False,
    in_model_frame: bool = True,
) -> ViewerFile:
    """Write Gaussians in the format of the file's suffix, atomically.

    Drops Gaussians without a meaning (``gaussians.sanitise``), and SH coefficients above the format's degree.

    Args:
        path: its folder must exist.
        params: see :mod:`sundae_ns.core.gaussians`. A :class:`Gaussians` says how it stores colours.
        antialiased: mark the scene as trained with antialiasing.
        upright: rotate from nerfstudio's axes to those of a 3DGS .ply, which viewers show upright; a .glb always is.
        in_model_frame: coordinates are those of nerfstudio's model, as a .ply then says.

    Raises:
        ConfigError: the suffix is not supported.
        DataError: wrong shapes, or the format cannot store the Gaussians.
        StorageError: the disk is full or not writable.
    """
    check_format(path)
    check_gaussians(params)
    sanitised = sanitise(params)
    gaussians = {name: value.detach().cpu() for name, value in sanitised.gaussians.as_harmonics().items()}
    kind = path.suffix.lower()
    if upright and kind != ".glb":
        gaussians = similarity(gaussians, _UPRIGHT, 1.0)
    coefficients = gaussians["features_rest"].shape[1]
    if kind != ".ply":
        gaussians["features_rest"] = gaussians["features_rest"][:, : (MAX_SH_DEGREE + 1) ** 2 - 1]
    if kind == ".ply":
        marks = {MODEL_FRAME: in_model_frame and not upright, ANTIALIASED: antialiased}
        write_ply(path, gaussians, comments=[comment for comment, applies in marks.items() if applies])
    elif kind == ".glb":
        write_glb(path, gaussians, antialiased=antialiased, in_model_frame=in_model_frame)
    else:
        (write_spz if kind == ".spz" else write_sog)(path, gaussians, antialiased=antialiased)
    kept = gaussians["features_rest"].shape[1]
    return ViewerFile(
        primitives=len(gaussians["means"]),
        dropped=sanitised.dropped,
        degree=sh_degree_of(kept) or 0,
        clamped=clamped(gaussians) if kind == ".spz" else 0,
        cut=kept < coefficients,
        bytes=path.stat().st_size,
    )
