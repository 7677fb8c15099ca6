"""Kinds of files, and one reader and one writer for files of Gaussians of all formats."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from sundae_ns.core.errors import CheckpointError, DataError, SundaeError, regular
from sundae_ns.core.gaussians import SPLAT_NAMES, Gaussians, Sanitised, sanitise, sh_degree
from sundae_ns.io import checkpoint
from sundae_ns.io.coordinates import Direction, recentred, similarity, upward
from sundae_ns.io.gltf import read_glb, write_glb
from sundae_ns.io.ply import STORED_SH_DEGREE, Marks, check_gaussians, comments_of, ply_marks, read_ply, write_ply
from sundae_ns.io.sog import METAS, read_sog, write_sog, write_streamed
from sundae_ns.io.splat import read_gsplat, read_ksplat, read_splat
from sundae_ns.io.spz import read_spz, write_spz

Kind = Literal["packed", "ply", "spz", "sog", "glb", "splat", "ksplat", "gsplat"]
Reader = Callable[[Path], tuple[dict[str, Tensor], Marks]]
FORMATS = (".ply", ".spz", ".sog", ".glb")  # that write_for_viewers writes
_BY_SUFFIX: dict[str, Kind] = {".ply": "ply", ".spz": "spz", ".sog": "sog", ".glb": "glb"}
_BY_SUFFIX |= {".splat": "splat", ".ksplat": "ksplat", ".pt": "gsplat"}
PRIMITIVES = {kind: f"{suffix} file" for suffix, kind in _BY_SUFFIX.items()} | {"gsplat": "checkpoint of gsplat"}
"""Kinds of files that hold Gaussians alone, and their names."""
_BY_SUFFIX[".zip"] = "sog"
_FIRST_BYTES: dict[bytes, Kind] = {b"\x89SUNDAE\n": "packed", b"ply\n": "ply", b"ply\r": "ply"}
_FIRST_BYTES |= {b"\x1f\x8b": "spz", b"NGSP": "spz", b"PK\x03\x04": "sog", b"glTF": "glb"}
_UNREAD = {
    **dict.fromkeys((".lcc", ".lcc2"), "is a scene of XGRIDS; convert it to .ply with SuperSplat or splat-transform"),
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), "is a scene of OpenUSD; export its Gaussians as .ply or .glb"),
    ".rad": "is a scene of Spark; convert the .ply that it was made of",
    ".html": "is a web page; give the scene that it was made of",
    ".gltf": "is a glTF scene in several files; export it as .glb",
    ".pth": "is a checkpoint of another trainer; give its .ply, such as point_cloud/iteration_*/point_cloud.ply",
    **dict.fromkeys(".rar .7z .tar .tgz .xz .zst .ssproj".split(), "is an archive; unpack it, and give its scene"),
}
_READERS: dict[Kind | None, Reader] = {"spz": read_spz, "sog": read_sog, "glb": read_glb}
_READERS |= {"splat": read_splat, "ksplat": read_ksplat, "gsplat": read_gsplat}
_WRITERS: dict[str, Callable[..., None]] = {".spz": write_spz, ".sog": write_sog, ".glb": write_glb}
_WRITERS[".ply"] = lambda path, gaussians, marks: write_ply(path, gaussians, comments=comments_of(marks))
# In nerfstudio and in gsplat's trainer, z points up; in a 3DGS .ply, -y does.
_MODEL_UP, _PLY_UP = (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)
UPRIGHT = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
_log = logging.getLogger(__name__)


def kind_of(path: Path) -> Kind | None:
    """Kind of the file at a path by its first bytes; None for any other file, a folder or a missing file."""
    try:
        with regular(path).open("rb") as file:
            first = file.read(max(map(len, _FIRST_BYTES)))
    except (OSError, ValueError):
        return None
    kind = next((kind for begin, kind in _FIRST_BYTES.items() if first.startswith(begin)), None)
    if kind not in ("sog", None):
        return kind
    # A checkpoint is a zip file too; the others have no header.
    suffixes = (".sog", ".zip", ".pt") if kind == "sog" else (".splat", ".ksplat")
    return _BY_SUFFIX[path.suffix.lower()] if path.suffix.lower() in suffixes else None


def kind_of_gaussians(path: Path) -> Kind | None:
    """Kind of a file of Gaussians, of a missing or damaged one by its suffix; None for all others.

    A .sog may be a folder of images, or the ``meta.json`` in it.
    """
    if path.name in METAS or (any((path / name).is_file() for name in METAS) and not (path / "config.yml").exists()):
        return "sog"
    if (kind := kind_of(path)) is None and not path.is_dir():
        kind = _BY_SUFFIX.get(path.suffix.lower())
    return kind if kind in PRIMITIVES else None


def unread(path: Path) -> str | None:
    """The kind of a scene that this program does not read, and how to convert it; None for any other path.

    >>> unread(Path("garden.lcc"))
    'is a scene of XGRIDS; convert it to .ply with SuperSplat or splat-transform'
    """
    if path.is_dir():
        # The folder of a training by the authors of 3DGS.
        clouds = sorted(path.glob("point_cloud/iteration_*/point_cloud.ply"), key=lambda each: (len(str(each)), each))
        return f"is a folder of 3DGS; give {clouds[-1]}" if clouds else None
    return _UNREAD.get(path.suffix.lower())


def read_gaussian_file(path: Path) -> tuple[Sanitised, Marks]:
    """Read a file of Gaussians of any program, and what it states of them. Nothing in it is executed.

    The Gaussians that have a meaning get finite values, float32 on the CPU. ``DataError`` if the file is missing,
    damaged, of another kind, or has no finite Gaussian.
    """
    kind = kind_of_gaussians(path)
    params, marks = _READERS[kind](path) if kind in _READERS else (read_ply(path), ply_marks(path))
    params["means"], offset = recentred(params["means"])
    if offset is not None:
        _log.warning("%s lies where float32 is too coarse; its coordinates are less %.10g %.10g %.10g", path, *offset)
        x, y, z = map(sum, zip(offset, marks.offset or (0.0, 0.0, 0.0), strict=True))
        marks = marks._replace(offset=(x, y, z))
    return usable(params, path, DataError), marks


def up_of(path: Path, means: Tensor, marks: Marks) -> Direction:
    """Upward direction that a file states; else that of its format or its ground, by its centres, which is logged."""
    kind = kind_of_gaussians(path)
    up = _MODEL_UP if kind == "gsplat" or marks.in_model_frame else _PLY_UP
    if marks.up is None and not marks.in_model_frame and kind != "glb":
        up, by_ground = upward(means, up)
        why = "its largest plane shows" if by_ground else "files of its kind have"
        _log.warning("%s states no upward direction; it is %.2g %.2g %.2g, as %s", path, *up, why)
    return marks.up or up


def usable(params: Mapping[str, Tensor], path: Path, failure: type[SundaeError] = CheckpointError) -> Sanitised:
    """The Gaussians of a file that have a meaning, with finite values; logs what was changed. None is a ``failure``."""
    sanitised = sanitise(params)
    if not sanitised.gaussians.num_gaussians:
        raise failure(f"{path} has {len(params['means']):,} Gaussians, and none is finite; export it again")
    if summary := sanitised.summary():
        _log.warning("%s: %s", path, summary)
    return sanitised


def read_gaussians(path: Path) -> tuple[dict[str, Tensor], bool]:
    """Read a checkpoint, the newest of a folder, a packed scene without its head, or a file of Gaussians.

    Returns finite Gaussians without features, float32 on the CPU (centres of survey coordinates are float64), colours
    as harmonics; and whether coordinates are those of nerfstudio's model, not of a capture. ``CheckpointError`` for no
    such file, no Gaussians, or another format; ``PackError`` for a damaged pack.
    """
    if not path.exists():
        raise CheckpointError(f"{path} does not exist; give a .ckpt file, the folder of them, or a .ply")
    if kind_of_gaussians(path) is not None:
        try:
            sanitised, marks = read_gaussian_file(path)
        except DataError as error:
            raise CheckpointError(str(error)) from error
        params = dict(sanitised.gaussians)
        if marks.offset is not None:
            params["means"] = params["means"].double() + torch.tensor(marks.offset, dtype=torch.float64)
        return params, marks.in_model_frame
    if kind_of(path) == "packed":
        from sundae_ns.io.pack.packed_scene import read_scene  # its decoder needs a compiler, which other files do not

        packed = read_scene(path)
        params = {name: packed.gaussians[name] for name in SPLAT_NAMES}
        model = packed.meta.get("model")
        logits = isinstance(model, dict) and model.get("sh_degree") == 0
        gaussians = Gaussians(params, "logits" if logits else "harmonics").as_harmonics()
        return dict(gaussians), (packed.meta.get("source") or {}).get("model_frame") is not False
    if (reason := unread(path)) is not None:
        raise CheckpointError(f"{path} {reason}")
    path, loaded = checkpoint.read_newest(path) if path.is_dir() else (path, checkpoint.read(path))
    return dict(usable(checkpoint.gaussians_of(loaded, path), path).gaussians.as_harmonics()), True


def write_for_viewers(
    path: Path, params: Mapping[str, Tensor], marks: Marks | None = None, *, upright: bool = False
) -> dict[str, Tensor]:
    """Write Gaussians in the format of the file's suffix, one of :data:`FORMATS`, atomically; its folder must exist.

    Drops Gaussians without a meaning (``gaussians.sanitise``), and SH coefficients above the format's degree. ``marks``
    are stated as far as the format can. ``upright`` rotates from nerfstudio's axes to those of a 3DGS .ply, which
    viewers show upright; a .glb always is. Returns the Gaussians of the file, on the CPU, before its format rounds
    them. ``DataError`` for wrong shapes or what the format cannot store; ``StorageError`` if it cannot be written.
    """
    kind = path.suffix.lower()
    gaussians, marks = _prepared(params, kind, marks or Marks(), upright)
    _WRITERS[kind](path, gaussians, marks)
    return gaussians


def write_levels(folder: Path, levels: Iterable[Mapping[str, Tensor]], marks: Marks, *, upright: bool = False) -> None:
    """Write levels of detail, the full one first, as streamed SOG; all else as :func:`write_for_viewers`."""
    written = [_prepared(level, ".sog", marks, upright) for level in levels]
    write_streamed(folder, [gaussians for gaussians, _ in written], written[0][1])


def _prepared(params: Mapping[str, Tensor], kind: str, marks: Marks, upright: bool) -> tuple[dict[str, Tensor], Marks]:
    """The Gaussians of a file of a kind, on the CPU, and its marks."""
    check_gaussians(params)
    gaussians = {name: value.detach().cpu() for name, value in sanitise(params).gaussians.as_harmonics().items()}
    if upright and kind != ".glb":
        gaussians = similarity(gaussians, UPRIGHT, 1.0)
        turn = UPRIGHT[:, :3].double().numpy()
        up, offset = (vector and tuple((turn @ vector).tolist()) for vector in (marks.up or _MODEL_UP, marks.offset))
        marks = marks._replace(in_model_frame=False, up=up, offset=offset)
    if kind != ".ply" and sh_degree(gaussians["features_rest"]) > STORED_SH_DEGREE:
        _log.warning("a %s holds no harmonics above SH degree %d; a .ply does", kind, STORED_SH_DEGREE)
        gaussians["features_rest"] = gaussians["features_rest"][:, : (STORED_SH_DEGREE + 1) ** 2 - 1]
    return gaussians, marks
