"""A scene in one file: Gaussians, head and cameras are sections of ``container``, all else is in its header.

``docs/formats.md`` lists the names, shapes and error bounds of all sections.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from sundae_ns.core.errors import PackError
from sundae_ns.core.files import write_bytes
from sundae_ns.core.gaussians import FEATURES, SPLAT_NAMES, finite_mask, num_gaussians
from sundae_ns.io.budget import afford
from sundae_ns.io.pack import container, entropy
from sundae_ns.io.pack.codecs import Blocks, Codecs, Sensitivity, as_matrix, fit_codecs, quats_at, rows_at, weights_at
from sundae_ns.io.pack.config import PackConfig
from sundae_ns.io.pack.container import FORMAT, MAX_RATIO, SPARE, Array, Coded, fault, fits, in_range
from sundae_ns.io.ply import check_gaussians

CAMERAS: dict[str, dict[str, Any]] = FORMAT["sections"]["cameras"]
"""dtype, shape and range of the arrays of M cameras: ``poses`` ``[M, 3, 4]``, camera-to-world with OpenGL axes in the
model's coordinates; ``intrinsics`` ``[M, 4]``, fx, fy, cx, cy in pixels; ``sizes`` ``[M, 2]``, width and height."""
_MAX_WIDTH: int = FORMAT["header"]["properties"]["attributes"]["properties"][FEATURES]["properties"]["width"]["maximum"]


@dataclass(frozen=True, eq=False)
class PackedScene:
    """All that is needed to render a scene."""

    gaussians: dict[str, Tensor]  # see core.gaussians; float32 on the CPU
    head: dict[str, Tensor] = field(default_factory=dict)  # its state; empty without a head
    cameras: dict[str, Tensor] | None = None  # by the names of CAMERAS
    meta: dict[str, Any] = field(default_factory=dict)  # JSON: the model's configuration, frame, and other entries
    sensitivity: Sensitivity = Sensitivity({}, {})  # what errors do to images; by default all weigh the same


class PackReport(NamedTuple):
    """Bytes of a packed scene, of each of its sections, and of its ``header``."""

    primitives: int
    bytes: int
    sections: dict[str, int]

    @property
    def bits(self) -> dict[str, float]:
        """Bits per Gaussian of each attribute, of ``head``, ``cameras`` and ``header``, and of ``all``."""
        sums = Counter[str]()
        for name, count in self.sections.items():
            sums[name.partition("/")[0]] += count
        return {name: 8 * count / self.primitives for name, count in {**sums, "all": self.bytes}.items()}

    def summary(self) -> dict[str, Any]:
        """JSON values: Gaussians, bytes, and the bits per Gaussian."""
        bits = {name: round(count, 2) for name, count in self.bits.items()}
        return {"primitives": self.primitives, "bytes": self.bytes, "bits": bits}


def _check(params: Mapping[str, Tensor]) -> None:
    check_gaussians(params, PackError)
    if (n := num_gaussians(params)) == 0:
        raise PackError("the scene has no Gaussians; there is nothing to pack")
    shape = params[FEATURES].shape if FEATURES in params else (n, 1)
    if len(shape) != 2 or shape[0] != n or not 1 <= shape[1] <= _MAX_WIDTH:
        raise PackError(f"features has shape {list(shape)}; it must be [{n}, 1 to {_MAX_WIDTH}]")
    known = {name: params[name].float() for name in (*SPLAT_NAMES, FEATURES) if name in params}
    if broken := n - int(finite_mask(known).sum()):
        raise PackError(f"{broken} of {n} Gaussians are not finite (NaN or infinite); prune the scene first")


def fit_scene(scene: PackedScene, config: PackConfig | None = None) -> tuple[PackedScene, Codecs]:
    """The scene with its Gaussians in the stored order and with rounded positions, and codecs fitted to it.

    Raises ``ConfigError`` for invalid options, ``PackError`` for no Gaussians, wrong shapes or values not finite.
    """
    config = config or PackConfig()
    config.validate()
    _check(scene.gaussians)
    gaussians, codecs = fit_codecs(scene.gaussians, scene.head, config, scene.sensitivity)
    return replace(scene, gaussians=gaussians), codecs


def write_fitted(path: Path, scene: PackedScene, codecs: Codecs) -> PackReport:
    """Pack a scene, atomically, with codecs that were fitted to it before or after training with rounding.

    Gaussians are in the order of :func:`fit_scene`. Their positions are ignored; the codecs hold them. Raises
    ``PackError`` if values are not finite, or the codecs do not fit the scene.
    """
    packed, sections = pack_bytes(scene, codecs)
    write_bytes(path, packed)
    sections["header"] = len(packed) - sum(sections.values())
    return PackReport(num_gaussians(scene.gaussians), len(packed), sections)


def pack_bytes(scene: PackedScene, codecs: Codecs) -> tuple[bytes, dict[str, int]]:
    """The bytes of the file that :func:`write_fitted` writes, and the number of bytes of each section."""
    _check(scene.gaussians)
    config, blocks = codecs.config, codecs.blocks
    n = num_gaussians(scene.gaussians)
    wanted = {"means", "features_rest", *codecs.gaussians}
    if n != len(blocks.codes) or set(scene.gaussians) != wanted or bool(scene.head) != (codecs.head is not None):
        raise PackError("the codecs were fitted to another scene; fit them again")
    arrays: dict[str, Array] = {"means/low": blocks.low, "means/high": blocks.high}
    arrays["means/gaps"] = entropy.encode_gaps(blocks.codes, config.block, config.position_bits)
    about: dict[str, Any] = {"means": {"codec": "blocks", "bits": config.position_bits, "block": config.block}}
    near = entropy.neighbours_of(blocks.cells, config.block)

    def coded(name: str) -> tuple[Coded, entropy.Stream]:
        codec: Any = codecs.gaussians.get(name, codecs.head)
        stored = codec.encode(scene.head if name == "head" else as_matrix(scene.gaussians[name]))
        around = entropy.predecessors(len(stored[1])) if name == "head" else near
        return stored, entropy.encode_levels(stored[1], around)

    names = [*codecs.gaussians, *(["head"] if scene.head else [])]
    with ThreadPoolExecutor(2) as pool:
        jobs = {name: pool.submit(coded, name) for name in reversed(names)}  # the largest first, as in _decoded
        for name in names:
            (about[name], _, parts), stream = jobs[name].result()
            arrays |= {f"{name}/levels": stream, **{f"{name}/{part}": array for part, array in parts.items()}}
    if scene.cameras is not None:
        for name, section in CAMERAS.items():
            arrays[f"cameras/{name}"] = scene.cameras[name].detach().cpu().numpy().astype(section["dtype"])
    meta = {**scene.meta, "primitives": n, "attributes": about}
    wrong = fault(meta, FORMAT["header"])
    for name, array in arrays.items():
        attribute, _, part = name.partition("/")
        if not in_range(array, FORMAT["sections"][about.get(attribute, {"codec": attribute})["codec"]][part]):
            wrong = name
    if wrong is not None:
        raise PackError(f"{wrong} has values that readers refuse; give other cameras, or drop the largest values")
    unpacked = 4 * sum(value.numel() for value in (*scene.gaussians.values(), *scene.head.values()))
    return container.encode(meta, arrays, unpacked=unpacked)


class _Sections(NamedTuple):
    size: int
    meta: dict[str, Any]
    arrays: dict[str, Array]


def _about(file: _Sections, attribute: str) -> dict[str, Any]:
    """The header's entry of an attribute."""
    if attribute not in file.meta["attributes"]:
        raise ValueError(f"its header has no valid attributes.{attribute}")
    return file.meta["attributes"][attribute]  # type: ignore[no-any-return]


def _array(file: _Sections, attribute: str, part: str, **lengths: int) -> Array:
    """A section in the dtype, shape and range that the format states; ``lengths`` are sides that it names."""
    codec = attribute if attribute == "cameras" else _about(file, attribute)["codec"]
    section = FORMAT["sections"][codec][part]
    name = f"{attribute}/{part}"
    if (array := file.arrays.get(name)) is None or not fits(array, section, lengths):
        raise ValueError(f"{name} is missing or has another shape")
    if not in_range(array, section):
        raise ValueError(f"{name} has values that are not finite or out of range")
    return array


def _decode_head(file: _Sections) -> dict[str, Tensor]:
    if "head/levels" not in file.arrays:
        return {}
    about = _about(file, "head")
    sources = {part: _array(file, "head", part) for part in ("plain", "steps", "columns")}
    tensors = {name: tuple(map(int, shape)) for name, shape in about["tensors"]}
    sizes = {name: math.prod(shape) for name, shape in tensors.items()}
    count = sum(sizes[name] for name, shape in tensors.items() if len(shape) > 1)
    if about["weights"] != count:
        raise ValueError("the head has another number of weights than it states")
    afford(4 * count, file.size, SPARE, MAX_RATIO)
    near = entropy.predecessors(count)
    sources["levels"] = entropy.decode_levels(_array(file, "head", "levels"), 1, near).reshape(-1)

    def take(part: str, count: int) -> Tensor:
        if count > len(sources[part]):
            raise ValueError("the head has fewer weights than it states")
        taken, sources[part] = np.split(sources[part], [count])
        return torch.from_numpy(taken.astype(np.float32))

    head: dict[str, Tensor] = {}
    for name, shape in tensors.items():
        if len(shape) <= 1:
            head[name] = take("plain", sizes[name]).reshape(shape)
        else:
            steps = take("steps", shape[0])[:, None] * take("columns", shape[1])
            head[name] = weights_at(take("levels", sizes[name]).reshape(shape), steps)
            if not torch.isfinite(head[name]).all():
                raise ValueError("the head has weights beyond float32")
    return head


def _decode_cameras(file: _Sections) -> dict[str, Tensor] | None:
    if "cameras/poses" not in file.arrays:
        return None
    arrays = {name: _array(file, "cameras", name, cameras=len(file.arrays["cameras/poses"])) for name in CAMERAS}
    arrays["sizes"] = arrays["sizes"].astype(np.int64)
    return {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}


def read_scene(path: Path) -> PackedScene:
    """Unpack a file, without executing anything in it, with memory bounded by its size; ``PackError`` if it is bad."""
    header = container.read_header(path)
    with container.naming(path):
        container.check(header.meta, "header")
        n, attributes = int(header.meta["primitives"]), header.meta["attributes"]
        width, features = (int(attributes.get(name, {"width": 0})["width"]) for name in ("features_rest", FEATURES))
        afford(4 * n * (14 + width + features), header.size, SPARE, MAX_RATIO)
        return _decoded(_Sections(header.size, header.meta, container.read_sections(path, header)), n, width, features)


def _decoded(file: _Sections, n: int, width: int, features: int) -> PackedScene:
    bits, size = (int(_about(file, "means")[key]) for key in ("bits", "block"))
    low, high = (_array(file, "means", end, blocks=-(-n // size)) for end in ("low", "high"))

    def levels(name: str, channels: int) -> tuple[Tensor, float]:
        coded = entropy.decode_levels(_array(file, name, "levels"), channels, near)
        return torch.from_numpy(coded), float(_about(file, name)["step"])

    def rows(name: str, channels: int) -> Tensor:
        coded, step = levels(name, channels)
        mean, basis = _array(file, name, "mean", width=channels), _array(file, name, "basis", square=channels**2)
        return rows_at(coded, torch.tensor(mean), torch.tensor(basis).reshape(channels, channels), step)

    with ThreadPoolExecutor(2) as pool:
        # A head needs no positions. Then the largest jobs come first, so that the threads end together.
        head = pool.submit(_decode_head, file)
        blocks = Blocks(entropy.decode_gaps(_array(file, "means", "gaps"), n, size, bits), low, high)
        near = entropy.neighbours_of(blocks.cells, size)
        wide, narrow = {"features_rest": width, FEATURES: features}, {"scales": 3, "features_dc": 3, "opacities": 1}
        jobs = {name: pool.submit(rows, name, channels) for name, channels in wide.items() if channels}
        jobs["quats"] = pool.submit(lambda: quats_at(*levels("quats", 3)))
        jobs |= {name: pool.submit(rows, name, channels) for name, channels in narrow.items()}
        jobs["means"] = pool.submit(lambda: torch.from_numpy(blocks.positions(bits, size)))
        gaussians = {name: job.result() for name, job in jobs.items()}
    gaussians["features_rest"] = gaussians.get("features_rest", torch.zeros(0)).reshape(n, width // 3, 3)
    ordered = {name: gaussians[name] for name in (*SPLAT_NAMES, FEATURES) if name in gaussians}
    meta = {name: value for name, value in file.meta.items() if name not in ("sections", "attributes", "primitives")}
    return PackedScene(ordered, head.result(), _decode_cameras(file), meta)
