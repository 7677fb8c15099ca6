"""The .sog of PlayCanvas, version 2: a zip of lossless WebP images with one pixel per Gaussian, and ``meta.json``.

Written from the format's public description, because no maintained Python package writes it:

    meta.json                  {"version": 2, "count", "antialias", "up", "means", "scales", "quats", "sh0", "shN"}
    means_l, means_u .webp     low and high bytes of 65,536 levels per axis, after sign(x) log(1 + |x|)
    scales.webp                log-scales, indices in a codebook of 256 numbers
    quats.webp                 the three smallest components, 8 bits each; alpha is 252 + the index of the largest
    sh0.webp                   SH coefficients of degree 0, indices in a codebook; alpha is the opacity
    shN_labels.webp            index in a palette of at most 65,536 rows, in red and green
    shN_centroids.webp         the palette: 64 rows of SH coefficients of degrees 1 to 3 in a row of pixels

Codebooks are k-means in one dimension. With more Gaussians than palette rows, these are centres of a two-level
k-means. Coordinates are those of a .ply, as in files of ``splat-transform``. Own entries of ``meta.json``, which other
programs ignore: ``up``; ``offset``, what was subtracted from coordinates too large for float32; and ``modelFrame``.

Streamed SOG, version 1: a folder of levels of detail, the full one first, in chunks that are folders of the above.

    lod-meta.json              {"version": 1, "count", "counts" of each level, "lodLevels", "filenames", "tree"}
    LEVEL_CHUNK-HASH/          meta.json and images; ``filenames`` lists the former. Readers take any other name

The tree cuts space at medians. Each node has its ``bound`` {"min", "max"}, which holds its Gaussians to three standard
deviations, and ``children`` or ``lods``: {"LEVEL": {"file", "offset", "count"}}, its rows of a chunk by the chunk's
index in ``filenames``. An ``environment`` of other programs is a chunk that belongs to every level.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import re
import shutil
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.core.covariance import entries_of
from sundae_ns.core.errors import DataError, reading, regular
from sundae_ns.core.files import replacing, write_files, write_text
from sundae_ns.io.budget import afford, afford_gaussians, joined, parsed_json, read_exactly
from sundae_ns.io.coordinates import scene_order
from sundae_ns.io.ply import ANTIALIASED, UNMARKED, Marks, check_gaussians, checked, from_smallest_three, vector

META, STREAMED = METAS = ("meta.json", "lod-meta.json")
MAX_PALETTE = 1 << 16  # palette rows that two bytes can index
_ROW_ENTRIES = 64  # palette rows in a row of the palette's image
_COARSE = 256  # coarse cells of a large palette
_LEVELS = 65535  # highest level of a position, in two bytes
_FIRST_MODE = 252  # alpha of a rotation without its first component; the next values stand for the other components
_LEAF, _CHUNK = 1 << 14, 1 << 18  # most Gaussians of the full level in a leaf, and of a chunk of several leaves
_ASSET = {"generator": "sundae-ns"}
_OWN_CHUNK = re.compile(r"\d+_\d+-[0-9a-f]{16}")
Entry = Callable[[str], bytes]  # the content of a file by its name beside the first one


def write_sog(path: Path, params: Mapping[str, Tensor], marks: Marks = UNMARKED) -> None:
    """Write the base colours of Gaussians that ``ply.checked`` accepts as a .sog, atomically, in another order."""
    gaussians = checked(path, params)
    order, _ = scene_order(gaussians["means"].numpy())
    with replacing(path) as unfinished, zipfile.ZipFile(unfinished, "w", zipfile.ZIP_STORED) as bundle:
        for name, content in _encoded({name: value.numpy()[order] for name, value in gaussians.items()}, marks).items():
            bundle.writestr(zipfile.ZipInfo(name), content)  # with a fixed date: equal scenes give equal bytes


def write_streamed(folder: Path, levels: Sequence[Mapping[str, Tensor]], marks: Marks = UNMARKED) -> None:
    """Write levels of detail, the full one first, as streamed SOG; each level as for :func:`write_sog`.

    An earlier ``lod-meta.json`` in the folder is valid until the new one is complete; then its chunks are removed.
    """
    arrays: list[dict[str, NDArray[np.float32]]] = []
    for params in levels:
        gaussians = checked(folder / STREAMED, params)
        order, _ = scene_order(gaussians["means"].numpy())
        reach = 3 * entries_of(gaussians)[:, :3].sqrt().float()
        gaussians |= {"min": gaussians["means"] - reach, "max": gaussians["means"] + reach}
        arrays.append({name: value.numpy()[order] for name, value in gaussians.items()})
    chunks: list[tuple[int, list[NDArray[np.int64]]]] = []  # levels, and the rows of each leaf
    newest: dict[int, int] = {}  # chunk of a level that is not full

    def add_leaf(level: int, rows: NDArray[np.int64]) -> dict[str, int]:
        if level not in newest or sum(map(len, chunks[newest[level]][1])) + len(rows) > _CHUNK:
            newest[level] = len(chunks)
            chunks.append((level, []))
        leaves = chunks[newest[level]][1]
        leaves.append(rows)
        return {"file": newest[level], "offset": sum(map(len, leaves[:-1])), "count": len(rows)}

    def node(rows: list[NDArray[np.int64]]) -> dict[str, Any]:
        levels = list(zip(arrays, rows, strict=True))
        low, high = (np.concatenate([level[end][some] for level, some in levels]) for end in ("min", "max"))
        bound = {"min": low.min(axis=0).tolist(), "max": high.max(axis=0).tolist()}
        centres = arrays[0]["means"][rows[0]]
        axis = np.ptp(centres, axis=0).argmax()
        below = [level["means"][some, axis] < np.median(centres[:, axis]) for level, some in levels]
        if len(centres) <= _LEAF or not below[0].any():
            return {"bound": bound, "lods": {str(i): add_leaf(i, some) for i, some in enumerate(rows) if len(some)}}
        halves = ([some[low == half] for some, low in zip(rows, below, strict=True)] for half in (True, False))
        return {"bound": bound, "children": [node(half) for half in halves]}

    counts = [len(level["means"]) for level in arrays]
    tree = node([np.arange(count) for count in counts])
    names: list[str] = []
    for level, leaves in chunks:
        rows = np.concatenate(leaves)
        contents = _encoded({name: value[rows] for name, value in arrays[level].items()}, marks)
        digest = hashlib.sha256(b"".join(contents.values())).hexdigest()[:16]
        names.append(f"{level}_{sum(name.startswith(f'{level}_') for name in names)}-{digest}/{META}")
        write_files({folder / Path(names[-1]).with_name(name): content for name, content in contents.items()})
    meta = {"version": 1, "asset": _ASSET, "count": sum(counts), "counts": counts, "lodLevels": len(counts)}
    write_text(folder / STREAMED, json.dumps({**meta, "filenames": names, "tree": tree}))
    for other in folder.iterdir():
        if _OWN_CHUNK.fullmatch(other.name) and f"{other.name}/{META}" not in names:
            shutil.rmtree(other)


def _encoded(arrays: Mapping[str, NDArray[np.float32]], marks: Marks) -> dict[str, bytes]:
    """The contents of the files of a .sog by their names, with Gaussians in the order of the arrays."""
    from PIL import Image

    n = len(arrays["means"])
    bent = np.sign(arrays["means"]) * np.log1p(np.abs(arrays["means"].astype(np.float64)))
    low, high = bent.min(axis=0), bent.max(axis=0)
    levels = np.rint((bent - low) / np.where(high > low, high - low, 1.0) * _LEVELS).astype(np.uint16)
    scale_values, scale_codes = codebook(arrays["scales"])
    color_values, color_codes = codebook(arrays["features_dc"])
    alphas = np.rint(255 / (1 + np.exp(-arrays["opacities"].astype(np.float64)))).astype(np.uint8)
    images = {
        "means_l": _square((levels & 255).astype(np.uint8)),
        "means_u": _square((levels >> 8).astype(np.uint8)),
        "scales": _square(scale_codes),
        "quats": _square(_smallest_three(arrays["quats"])),
        "sh0": _square(np.concatenate([color_codes, alphas], axis=1)),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": _ASSET,
        "count": n,
        "antialias": marks.antialiased,
        **({"model": "antialiased"} if marks.antialiased else {}),  # what splat-transform reads
        **({"modelFrame": True} if marks.in_model_frame else {}),
        **{name: list(value) for name in ("up", "offset") if (value := getattr(marks, name))},
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_values.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_values.tolist(), "files": ["sh0.webp"]},
    }
    if coefficients := arrays["features_rest"].shape[1]:
        rows, labels = palette(arrays["features_rest"].reshape(n, -1))
        values, codes = codebook(rows.reshape(len(rows), coefficients, 3))
        padded = np.zeros((math.ceil(len(rows) / _ROW_ENTRIES) * _ROW_ENTRIES, coefficients, 3), np.uint8)
        padded[: len(rows)] = codes
        images["shN_centroids"] = padded.reshape(-1, _ROW_ENTRIES * coefficients, 3)
        images["shN_labels"] = _square(np.stack([labels & 255, labels >> 8, 0 * labels], axis=1).astype(np.uint8))
        files = ["shN_centroids.webp", "shN_labels.webp"]
        bands = math.isqrt(coefficients + 1) - 1
        meta["shN"] = {"count": len(rows), "bands": bands, "codebook": values.tolist(), "files": files}
    contents = {META: json.dumps(meta).encode()}
    for name, pixels in images.items():
        image = io.BytesIO()
        # exact: keep colours where alpha, here the opacity, is 0.
        Image.fromarray(pixels).save(image, "WEBP", lossless=True, exact=True)
        contents[f"{name}.webp"] = image.getvalue()
    return contents


def read_sog(path: Path) -> tuple[dict[str, Tensor], Marks]:
    """Read a .sog, a .zip of one or of its folder, or a folder of images or the ``meta.json`` in it; or streamed SOG.

    Returns Gaussians as of ``ply.read_ply``, their means in float64, and what it states of them. Of streamed SOG, which
    may be a .zip too, these are the finest level and the environment.
    """
    with reading(path, "a complete .sog", remedy="export it again, or unzip it"), ExitStack() as stack:
        if path.is_dir() or path.name in METAS:
            folder = path if path.is_dir() else path.parent
            streamed = path.name != META and (path.name == STREAMED or (folder / STREAMED).exists())
            size = sum(file.stat().st_size for file in folder.rglob("*.webp"))
            entry: Entry = partial(_file_entry, folder)
        else:
            size = regular(path).stat().st_size
            entry, streamed = _bundled(stack.enter_context(zipfile.ZipFile(path)), size)
        return (_finest_level if streamed else _scene)(path, entry, size)


def _scene(path: Path, entry: Entry, size: int) -> tuple[dict[str, Tensor], Marks]:
    meta = parsed_json(entry(META))
    if (version := meta.get("version", 1)) not in (2, "2"):
        raise DataError(f"{path} has version {version}, not 2; convert it by splat-transform, gsplat's folder to .ply")
    up, offset = (vector(" ".join(map(str, meta.get(name, ())))) for name in ("up", "offset"))
    antialiased = any(str(meta.get(name)).lower() in ANTIALIASED for name in ("antialias", "model"))
    return _decoded(entry, meta, size), Marks(antialiased, meta.get("modelFrame") is True, up, offset)


def _finest_level(path: Path, entry: Entry, size: int) -> tuple[dict[str, Tensor], Marks]:
    meta = parsed_json(entry(STREAMED))
    if (version := meta.get("version", 1)) not in (1, "1"):
        raise DataError(f"{path} has version {version} of streamed SOG, this program reads 1; update it")
    files: dict[str, list[tuple[int, int]]] = {}  # offset and number of the rows of each leaf
    names = dict(enumerate(meta["filenames"]))  # no index counts from the end
    nodes = [meta["tree"]]
    while nodes:
        node = nodes.pop()
        nodes += node.get("children", ())
        if levels := node.get("lods"):
            finest = levels[min(levels, key=int)]
            files.setdefault(names[finest["file"]], []).append((finest["offset"], finest["count"]))
    if meta.get("environment"):
        files[meta["environment"]] = []
    parts: list[dict[str, Tensor]] = []
    marks = UNMARKED
    for file, leaves in files.items():
        part, stated = _scene(path, lambda name, file=file: entry(file.removesuffix(META) + name), size)  # type: ignore[misc]
        marks = marks if parts else stated  # those of the scene, not of its environment
        afford(sum(value.nbytes for each in (*parts, part) for value in each.values()), size)
        rows = torch.full((len(part["means"]),), not leaves)
        for offset, count in leaves:
            if not 0 <= offset <= offset + count <= len(rows) or bool(rows[offset : offset + count].any()):
                raise ValueError(f"leaves share Gaussians of {file}, or it has fewer")
            rows[offset : offset + count] = True
        parts.append({name: value[rows] for name, value in part.items()})
    return joined(parts, size), marks


def _file_entry(folder: Path, name: str) -> bytes:
    if Path(name).is_absolute() or ".." in Path(name).parts or not (folder / name).exists():
        raise ValueError(f"{name} is missing, or lies elsewhere")
    return regular(folder / name).read_bytes()


def _bundled(bundle: zipfile.ZipFile, size: int, *, inner: bool = False) -> tuple[Entry, bool]:
    """A reader of entries of a zip, whose files may be in a folder or in another zip; and whether it is streamed."""
    names = {name: PurePosixPath(name.replace("\\", "/")).name for name in bundle.namelist()}  # some are of Windows
    main = STREAMED if STREAMED in names.values() else META
    metas = [name for name, last in names.items() if last == main]
    scenes = [name for name, last in names.items() if last.lower().endswith(".sog") and not last.startswith(".")]
    if len(scenes) == 1 and not metas and not inner:
        return _bundled(zipfile.ZipFile(io.BytesIO(_zip_entry(bundle, size, "", scenes[0]))), size, inner=True)
    if len(metas) != 1:
        raise ValueError(f"it holds {len(metas)} {META} and {len(scenes)} .sog, not one of them")
    return partial(_zip_entry, bundle, size, metas[0].removesuffix(main)), main == STREAMED


def _zip_entry(bundle: zipfile.ZipFile, size: int, folder: str, name: str) -> bytes:
    info = bundle.getinfo(folder + name)
    # The other methods unpack in one go, whatever size an entry states.
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is compressed by method {info.compress_type}")
    afford(info.file_size, size)
    with bundle.open(info) as file:
        return read_exactly(file, info.file_size)  # to inflate no more than it states


def _decoded(file: Entry, meta: Mapping[str, Any], size: int) -> dict[str, Tensor]:
    """Gaussians from the files by their names, which have ``size`` bytes; the inverse of :func:`_encoded`."""
    n = int(meta["count"])
    coefficients = (int(meta["shN"]["bands"]) + 1) ** 2 - 1 if "shN" in meta else 0
    afford_gaussians(n, coefficients, size)

    def pixels(entry: Mapping[str, Any], index: int, channels: int) -> NDArray[np.uint8]:
        return _pixels(file(entry["files"][index]), n).reshape(-1, 4)[:n, :channels]

    low, high = (np.asarray(meta["means"][end], np.float64) for end in ("mins", "maxs"))
    if n != float(meta["count"]) or {low.shape, high.shape} != {(3,)}:
        raise ValueError("its count is no whole number, or mins and maxs of its means are not three numbers each")
    bent = low + (pixels(meta["means"], 0, 3) + 256.0 * pixels(meta["means"], 1, 3)) / _LEVELS * (high - low)
    color = pixels(meta["sh0"], 0, 4)
    opacity = np.clip(color[:, 3:] / 255.0, 1e-3 / 255, 1 - 1e-6)
    turns = pixels(meta["quats"], 0, 4)
    largest = turns[:, 3].astype(np.int64) - _FIRST_MODE
    if ((largest < 0) | (largest > 3)).any():
        raise ValueError("a rotation has no valid mode")
    rest = np.zeros((n, 0, 3), np.float32)
    if coefficients:
        centres = _pixels(file(meta["shN"]["files"][0]), MAX_PALETTE * coefficients)
        label = pixels(meta["shN"], 1, 2).astype(np.int64) @ [1, 256]
        rows = centres[..., :3].reshape(len(centres) * _ROW_ENTRIES, coefficients, 3)
        rest = np.asarray(meta["shN"]["codebook"], np.float32)[rows[label]]
    arrays = {
        "scales": np.asarray(meta["scales"]["codebook"], np.float32)[pixels(meta["scales"], 0, 3)],
        "quats": from_smallest_three((turns[:, :3] / 255.0 - 0.5) * math.sqrt(2.0), largest),
        "features_dc": np.asarray(meta["sh0"]["codebook"], np.float32)[color[:, :3]],
        "features_rest": rest,
        "opacities": np.log(opacity / (1 - opacity)),
    }
    if len(bent) != n:
        raise ValueError(f"its images have fewer than {n:,} pixels")
    gaussians = {name: torch.from_numpy(np.ascontiguousarray(value, np.float32)) for name, value in arrays.items()}
    gaussians["means"] = torch.from_numpy(np.sign(bent) * np.expm1(np.abs(bent)))  # float64, as survey coordinates need
    check_gaussians(gaussians, ValueError)
    return gaussians


def _pixels(file: bytes, needed: int) -> NDArray[np.uint8]:
    """A WebP image ``[H, W, 4]`` of about as many pixels as are needed, whose kind and size are checked before."""
    from PIL import Image

    start = 12
    while (kind := file[start : start + 4]) not in (b"VP8L", b"VP8 ", b"ANMF", b""):
        length = int.from_bytes(file[start + 4 : start + 8], "little")
        start += 8 + length + length % 2
    bits = int.from_bytes(file[start + 9 : start + 13], "little")
    width, height = 1 + bits % (1 << 14), 1 + (bits >> 14) % (1 << 14)
    if kind != b"VP8L":
        raise ValueError("an image is no lossless WebP: its numbers are not those of the Gaussians")
    if width * height > 4 * needed + 65536:
        raise ValueError(f"an image has {width} x {height} pixels for {needed:,} values")
    with Image.open(io.BytesIO(file), formats=["WEBP"]) as image:
        return np.asarray(image.convert("RGBA"))


def codebook(values: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Ascending numbers ``[256]`` for finite values, by k-means (Lloyd, 1957), and the nearest's index for each."""
    ordered = np.sort(values, axis=None).astype(np.float64)
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    # Start with half of the centres at quantiles and half spread evenly, for the few values at the ends.
    quantiles = np.quantile(ordered, (np.arange(128) + 0.5) / 128)
    centres = np.sort(np.concatenate([quantiles, np.linspace(ordered[0], ordered[-1], 128)]))
    middles = partial(np.convolve, (0.5, 0.5), mode="valid")  # between neighbours
    for _ in range(30):
        bounds = np.concatenate([[0], np.searchsorted(ordered, middles(centres)), [len(ordered)]])
        number = np.diff(bounds)
        # Sort again: rounding of the sums may swap neighbouring means.
        centres = np.sort(np.where(number > 0, np.diff(sums[bounds]) / np.maximum(number, 1), centres))
    numbers = centres.astype(np.float32)
    return numbers, np.searchsorted(middles(numbers.astype(np.float64)), values).astype(np.uint8)


def palette(rows: NDArray[np.float32], max_rows: int = MAX_PALETTE) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """A palette ``[P, D]`` of at most ``max_rows`` rows, fitted to rows ``[N, D]``, and the index of each row ``[N]``.

    By 256 coarse cells, with centres in proportion to their rows: one k-means of 65,536 centres would take hours.
    """
    if (n := len(rows)) <= max_rows:
        return rows, np.arange(n)
    generator = torch.Generator().manual_seed(0)
    vectors = torch.from_numpy(np.ascontiguousarray(rows)).double()
    cell_of = _nearest_centre(vectors, kmeans(vectors, _COARSE, generator))
    centres: list[Tensor] = []
    labels = torch.empty(n, dtype=torch.int64)
    for cell in cell_of.unique():
        (members,) = torch.nonzero(cell_of == cell, as_tuple=True)
        fine = kmeans(vectors[members], min(1 + (max_rows - _COARSE) * len(members) // n, len(members)), generator)
        labels[members] = sum(map(len, centres)) + _nearest_centre(vectors[members], fine)
        centres.append(fine)
    return torch.cat(centres).float().numpy(), labels.numpy()


def kmeans(rows: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Centres ``[count, D]`` by Lloyd iterations on a sample of the rows."""
    sample = rows[torch.randperm(len(rows), generator=generator)[: 1 << 16]]
    centres = sample[:count].clone()
    for _ in range(8):
        nearest = _nearest_centre(sample, centres)
        number = torch.bincount(nearest, minlength=count)[:, None]
        sums = torch.zeros_like(centres).index_add_(0, nearest, sample)
        centres = torch.where(number > 0, sums / number.clamp_min(1), centres)
    return centres


def _nearest_centre(rows: Tensor, centres: Tensor) -> Tensor:
    """Index ``[N]`` of the nearest centre of each row."""
    # |x - c|^2 minus |x|^2, in float32: a wrong choice between nearly equal centres costs nothing.
    flat, half = centres.float(), (centres * centres).sum(dim=1).float() / 2
    return torch.cat([(chunk.float() @ flat.T - half).argmax(dim=1) for chunk in rows.split(1 << 14)])


def _smallest_three(quats: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Unit quaternions wxyz as pixels, both ``[N, 4]``: the three smallest components, and the index of the largest."""
    largest = np.abs(quats).argmax(axis=1)
    positive = quats * np.where(quats[np.arange(len(quats)), largest] < 0, -1, 1)[:, None]
    others = positive[np.arange(4) != largest[:, None]].reshape(-1, 3)
    codes = np.rint((others * math.sqrt(0.5) + 0.5) * 255).clip(0, 255)
    return np.concatenate([codes, _FIRST_MODE + largest[:, None]], axis=1).astype(np.uint8)


def _square(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Pixels ``[N, C]`` as a nearly square image ``[H, W, C]``, with zeros at the end of the last row."""
    n, channels = pixels.shape
    width = math.isqrt(n - 1) + 1
    image = np.zeros((math.ceil(n / width) * width, channels), np.uint8)
    image[:n] = pixels
    return image.reshape(-1, width, channels)
