"""A whole scene in one file: the field, the head and the cameras as sections of ``container``, the rest in its header.

``docs/packing.md`` has the names, the shapes and the error bounds of all sections.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from dataclasses import field as default
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.errors import PackError
from sundae_ns.gaussians.parameters import FEATURES, SPLAT_NAMES, finite_mask, num_primitives, odd_shapes, sh_degree_of
from sundae_ns.storage.packing import codebooks, container, quantize, transform
from sundae_ns.storage.packing.codebooks import Codebooks
from sundae_ns.storage.packing.codecs import Codecs, as_matrix, fit, part_crumbs
from sundae_ns.storage.packing.config import PackConfig
from sundae_ns.storage.packing.container import Array
from sundae_ns.storage.packing.quantize import Blocks, Rotations, Uniform
from sundae_ns.storage.packing.transform import Transformed

CAMERAS = {"poses": ("<f4", (3, 4)), "intrinsics": ("<f8", (4,)), "sizes": ("<u4", (2,))}
"""Arrays of the cameras, ``[M, ...]`` each: camera-to-world with OpenGL axes in the model's coordinates; fx, fy, cx, cy in
pixels; width and height in pixels."""
_MOST_FEATURES = 256


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that is needed to show a scene."""

    field: dict[str, Tensor]
    """Parameters as ``gaussians.parameters`` has them, float32 on the CPU."""
    head: dict[str, Tensor] = default(default_factory=dict)
    """State of the compensation head; empty without one."""
    cameras: dict[str, Tensor] | None = None
    """Cameras to show it from, by the names of :data:`CAMERAS`."""
    meta: dict[str, Any] = default(default_factory=dict)
    """Plain values of JSON: the model's configuration, the frame, and whatever else the caller wants to keep."""


class PackReport(NamedTuple):
    """What a packed scene takes."""

    primitives: int
    bytes: int
    """Of the whole file."""
    sections: dict[str, int]
    """Bytes of each section, and of ``header``."""

    @property
    def bits(self) -> dict[str, float]:
        """Bits a primitive of each attribute; of ``head``, ``cameras`` and ``header``, their share."""
        sums: dict[str, float] = {}
        for name, count in self.sections.items():
            attribute = name.partition("/")[0]
            sums[attribute] = sums.get(attribute, 0.0) + 8 * count / self.primitives
        return sums


def _check(params: Mapping[str, Tensor]) -> None:
    missing = [name for name in SPLAT_NAMES if name not in params]
    if missing:
        raise PackError(f"the field has no {', '.join(missing)}; it needs all of {', '.join(SPLAT_NAMES)}")
    n = num_primitives(params)
    if n == 0:
        raise PackError("the field has no primitives; there is nothing to pack")
    for odd in odd_shapes(params):
        raise PackError(odd)
    features = params.get(FEATURES)
    if features is not None and not (
        features.ndim == 2 and len(features) == n and 1 <= features.shape[1] <= _MOST_FEATURES
    ):
        raise PackError(f"features has shape {list(features.shape)}; it must be [{n}, 1 to {_MOST_FEATURES}]")
    known = {name: params[name].float() for name in (*SPLAT_NAMES, FEATURES) if name in params}
    broken = n - int(finite_mask(known).sum())
    if broken:
        raise PackError(f"{broken} of {n} primitives are not finite (NaN or infinite); prune the field first")


# ------------------------------------------------------------------------------------------------------------- encoding


def fit_scene(scene: Scene, config: PackConfig | None = None) -> tuple[Scene, Codecs]:
    """Choose how to store a scene.

    Args:
        scene: at least one primitive, all finite.
        config: in how many bits.

    Returns:
        The scene with its primitives in the order in which they are stored and their positions rounded, and the codecs.

    Raises:
        ConfigError: an option cannot work.
        PackError: the field has no primitives, odd shapes or values that are not finite.
    """
    config = config or PackConfig()
    config.validate()
    _check(scene.field)
    field, codecs = fit(scene.field, scene.head, config)
    return replace(scene, field=field), codecs


def write_scene(path: Path, scene: Scene, config: PackConfig | None = None) -> PackReport:
    """Pack a scene into one file, whole or not at all.

    Args:
        path: the file; its folder must exist.
        scene: at least one primitive, all finite. Its primitives come back in another order.
        config: in how many bits.

    Raises:
        ConfigError: an option cannot work.
        PackError: the field has no primitives, odd shapes or values that are not finite.
        StorageError: no room or no right to write.
    """
    return write_fitted(path, *fit_scene(scene, config))


def write_fitted(path: Path, scene: Scene, codecs: Codecs) -> PackReport:
    """Pack a scene by codecs that were fitted to it, or to what it was before it was trained with them.

    Args:
        path: the file; its folder must exist.
        scene: primitives in the order of :func:`fit_scene`. Positions are those of the codecs, whatever it has.
        codecs: from :func:`fit_scene`.

    Raises:
        PackError: values are not finite, or it is another scene.
        StorageError: no room or no right to write.
    """
    _check(scene.field)
    config, blocks = codecs.config, codecs.blocks
    n = num_primitives(scene.field)
    wanted = {"means", "features_rest", *codecs.field}
    if n != len(blocks.deltas) or set(scene.field) != wanted or bool(scene.head) != (codecs.head is not None):
        raise PackError("the codecs were fitted to another scene; fit them again")
    about: dict[str, Any] = {"means": {"codec": "blocks", "bits": config.position_bits, "block": config.block}}
    arrays: dict[str, Array] = {"means/deltas": blocks.deltas, "means/low": blocks.low, "means/high": blocks.high}
    encoded = {name: codec.encode(as_matrix(scene.field[name])) for name, codec in codecs.field.items()}
    if codecs.head is not None:
        encoded["head"] = codecs.head.encode(scene.head)
    for name, (described, made) in encoded.items():
        about[name] = described
        arrays |= {f"{name}/{part}": array for part, array in made.items()}
    if scene.cameras is not None:
        for name, (dtype, _) in CAMERAS.items():
            arrays[f"cameras/{name}"] = scene.cameras[name].detach().cpu().numpy().astype(dtype)

    meta = {**scene.meta, "primitives": n, "attributes": about}
    unpacked = 4 * sum(value.numel() for value in (*scene.field.values(), *scene.head.values()))
    size = container.write(path, meta, arrays, unpacked=unpacked, level=config.level)
    sections = {name: section.length for name, section in container.read_header(path).sections.items()}
    sections["header"] = size - sum(sections.values())
    return PackReport(n, size, sections)


# ------------------------------------------------------------------------------------------------------------- decoding


class _Reader:
    """Sections of a file, each checked for what it must be before it is used."""

    def __init__(self, path: Path, header: container.Header, arrays: Mapping[str, Array]) -> None:
        self.path = path
        self.meta = header.meta
        self.arrays = arrays

    def refuse(self, reason: str) -> PackError:
        return PackError(f"{self.path} is no scene that can be shown ({reason}); pack it again")

    def section(self, name: str, dtypes: tuple[str, ...], shape: tuple[int | None, ...]) -> Array:
        array = self.arrays.get(name)
        fits = array is not None and array.dtype.str in dtypes and len(array.shape) == len(shape)
        if array is None or not fits or any(w is not None and w != s for w, s in zip(shape, array.shape)):
            raise self.refuse(f"{name} is missing or has another shape")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise self.refuse(f"{name} has values that are not finite")
        return array

    def about(self, name: str, codec: tuple[str, ...]) -> dict[str, Any]:
        attributes = self.meta.get("attributes")
        found = attributes.get(name) if isinstance(attributes, dict) else None
        if not isinstance(found, dict) or found.get("codec") not in codec:
            raise self.refuse(f"it does not say how {name} is stored")
        return found

    def number(self, about: Mapping[str, Any], key: str, least: int, most: int) -> int:
        value = about.get(key)
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
            raise self.refuse(f"{key} is not one of {least} to {most}")
        return value

    def numbers(self, about: Mapping[str, Any], key: str, count: int) -> NDArray[np.float64]:
        value = about.get(key)
        if not isinstance(value, list) or len(value) != count or not all(type(v) in (int, float) for v in value):
            raise self.refuse(f"{key} is not a list of {count} numbers")
        try:
            array = np.array(value, np.float64)
        except OverflowError:
            array = np.array([np.inf])
        # Grids reach up to 2^16 steps, times a few in a transform; what is shown must still be a number in float32.
        if not (np.abs(array) < np.finfo(np.float32).max / 2**20).all():
            raise self.refuse(f"{key} has values that are no numbers of float32")
        return array

    def places(self, name: str, limit: int) -> Array:
        array = self.section(name, ("<u4",), (None,))
        if len(array) and int(array.max()) >= limit:
            raise self.refuse(f"{name} points outside of the field")
        return array


def _decode_means(reader: _Reader, n: int) -> NDArray[np.float32]:
    about = reader.about("means", ("blocks",))
    bits, size = reader.number(about, "bits", 4, 21), reader.number(about, "block", 16, 1 << 20)
    count = -(-n // size)
    deltas = reader.section("means/deltas", ("<u8",), (n,))
    low, high = (reader.section(f"means/{end}", ("<f4",), (count, 3)) for end in ("low", "high"))
    return quantize.dequantize_positions(Blocks(deltas, low, high), bits, min(size, n))


def _decode_quats(reader: _Reader, n: int) -> NDArray[np.float32]:
    about = reader.about("quats", ("smallest-three",))
    bits = reader.number(about, "bits", 4, 16)
    codes = reader.section("quats/codes", (_code(bits),), (3, n))
    largest = part_crumbs(reader.section("quats/largest", ("|u1",), (-(-n // 4),)), n)
    return quantize.dequantize_rotations(Rotations(codes, largest), bits)


def _code(bits: int) -> str:
    return "|u1" if bits <= 8 else "<u2"


def _decode_uniform(reader: _Reader, name: str, n: int, width: int) -> NDArray[np.float32]:
    about = reader.about(name, ("uniform",))
    bits = reader.number(about, "bits", 4, 16)
    codes = reader.section(f"{name}/codes", (_code(bits),), (width, n))
    if about.get("differences") is True:
        if width != 3:
            raise reader.refuse(f"{name} has no three channels")
        codes = np.stack([codes[0] + codes[1], codes[1], codes[2] + codes[1]])
    places = reader.places(f"{name}/places", width * n)
    exceptions = reader.section(f"{name}/exceptions", ("<f4",), (len(places),))
    low, step = reader.numbers(about, "low", width), reader.numbers(about, "step", width)
    return quantize.dequantize(Uniform(codes, low, step, places, exceptions))


def _decode_transform(reader: _Reader, name: str, n: int, width: int) -> NDArray[np.float32]:
    about = reader.about(name, ("transform",))
    (step,) = reader.numbers({"step": [about.get("step")]}, "step", 1)
    codes = reader.section(f"{name}/codes", ("|i1", "<i2"), (width, n))
    basis = reader.section(f"{name}/basis", ("|i1",), (width * width,)).reshape(width, width)
    rows = reader.places(f"{name}/rows", n)
    exact = reader.section(f"{name}/exact", ("<f4",), (len(rows), width))
    return transform.backward(Transformed(codes, basis, float(step), rows, exact))


def _decode_books(reader: _Reader, name: str, n: int, width: int) -> NDArray[np.float32]:
    reader.about(name, ("codebooks",))
    indices = reader.section(f"{name}/indices", ("|u1",), (None, n))
    books = len(indices)
    if not 1 <= books <= 32:
        raise reader.refuse(f"{name} has {books} codebooks")
    flat = reader.section(f"{name}/entries", ("|i1",), (books, None))
    entries = flat.reshape(books, -1, width) if flat.shape[1] % width == 0 else flat[:, :0, None]
    if entries.shape[1] <= int(indices.max()):
        raise reader.refuse(f"{name} points outside of its codebooks")
    steps = reader.section(f"{name}/steps", ("<f4",), (books,))
    if not np.abs(steps).max() < np.finfo(np.float32).max / 2**13:
        raise reader.refuse(f"{name} has values that are no numbers of float32")
    rows = reader.places(f"{name}/rows", n)
    exact = reader.section(f"{name}/exact", ("<f4",), (len(rows), width))
    return codebooks.restore(Codebooks(indices, entries, steps, rows, exact, 0.0))


def _decode_head(reader: _Reader) -> dict[str, Tensor]:
    if "head/weights" not in reader.arrays:
        return {}
    about = reader.about("head", ("int8", "fp16"))
    plain = reader.section("head/plain", ("<f4",), (None,))
    coded = about["codec"] == "int8"
    weights = reader.section("head/weights", ("|i1",) if coded else ("<f2",), (None,))
    steps = reader.section("head/steps", ("<f4",), (None,)) if coded else np.zeros(0, np.float32)
    taken = {"plain": 0, "weights": 0, "steps": 0}

    def take(name: str, source: Array, count: int) -> Array:
        start = taken[name]
        taken[name] += count
        if taken[name] > len(source):
            raise reader.refuse("the head has fewer weights than it states")
        return source[start : taken[name]]

    head: dict[str, Tensor] = {}
    for name, shape in _tensors(reader, about.get("tensors")):
        count = int(np.prod(shape, dtype=object))
        if len(shape) <= 1:
            value = take("plain", plain, count).copy()
        elif coded:
            codes, step = take("weights", weights, count), take("steps", steps, shape[0])
            value = quantize.dequantize_weights(codes.reshape(shape), step)
        else:
            value = take("weights", weights, count).astype(np.float32)
        head[name] = torch.from_numpy(value.reshape(shape))
    return head


def _tensors(reader: _Reader, listed: Any) -> list[tuple[str, tuple[int, ...]]]:
    """Names and shapes of the head's tensors."""
    if not isinstance(listed, list) or len(listed) > 10_000:
        raise reader.refuse("it does not list the tensors of the head")
    found = []
    for entry in listed:
        fits = isinstance(entry, list) and len(entry) == 2 and isinstance(entry[0], str) and isinstance(entry[1], list)
        if not fits or len(entry[1]) > 5 or not all(type(side) is int and 0 < side < 1 << 28 for side in entry[1]):
            raise reader.refuse("a tensor of the head has an odd shape")
        found.append((entry[0], tuple(entry[1])))
    return found


def _decode_cameras(reader: _Reader) -> dict[str, Tensor] | None:
    if "cameras/poses" not in reader.arrays:
        return None
    count = len(reader.arrays["cameras/poses"])
    arrays = {
        name: reader.section(f"cameras/{name}", (dtype,), (count, *shape)) for name, (dtype, shape) in CAMERAS.items()
    }
    if count and (int(arrays["sizes"].min()) < 1 or int(arrays["sizes"].max()) > 1 << 16):
        raise reader.refuse("a camera has no size that a picture can have")
    arrays["sizes"] = arrays["sizes"].astype(np.int64)
    return {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}


def read_scene(path: Path) -> Scene:
    """Unpack a file. Nothing in it is run, and what it may allocate is bounded by its size.

    Raises:
        PackError: the file is missing, of another version, cut short, altered, or no scene.
    """
    path = Path(path)
    header = container.read_header(path)
    n, width, features = _shape(path, header)
    container.check_ratio(path, 4 * n * (14 + width + features), header.size)
    reader = _Reader(path, header, container.read_sections(path, header))

    # The largest first, so that the threads end together.
    jobs: dict[str, Callable[[], NDArray[np.float32]]] = {}
    decoders = {"transform": _decode_transform, "codebooks": _decode_books, "uniform": _decode_uniform}
    for name, channels in (("features_rest", width), (FEATURES, features)):
        if channels:
            decode = decoders[reader.about(name, tuple(decoders))["codec"]]
            jobs[name] = partial(decode, reader, name, n, channels)
    jobs["means"] = partial(_decode_means, reader, n)
    jobs["quats"] = partial(_decode_quats, reader, n)
    for name, channels in (("scales", 3), ("features_dc", 3), ("opacities", 1)):
        jobs[name] = partial(_decode_uniform, reader, name, n, channels)
    with ThreadPoolExecutor(2) as pool:
        started = {name: pool.submit(job) for name, job in jobs.items()}
        field = {name: torch.from_numpy(future.result()) for name, future in started.items()}
    rest = field.get("features_rest")
    field["features_rest"] = torch.zeros(n, 0, 3) if rest is None else rest.reshape(n, width // 3, 3)
    ordered = {name: field[name] for name in (*SPLAT_NAMES, FEATURES) if name in field}
    meta = {name: value for name, value in header.meta.items() if name not in ("sections", "attributes", "primitives")}
    return Scene(ordered, _decode_head(reader), _decode_cameras(reader), meta)


def _shape(path: Path, header: container.Header) -> tuple[int, int, int]:
    """Primitives, coefficients of bands 1 and up, and features, as the sections' sizes say, before any is read."""
    refusal = PackError(f"{path} is no scene that can be shown (its header contradicts itself); pack it again")
    attributes, n = header.meta.get("attributes"), header.meta.get("primitives")
    if not isinstance(attributes, dict) or type(n) is not int or not 1 <= n < 1 << 28:
        raise refusal
    widths = []
    for name in ("features_rest", FEATURES):
        about = attributes.get(name)
        if about is None:
            widths.append(0)
            continue
        if not isinstance(about, dict):
            raise refusal
        codes = header.sections.get(f"{name}/codes")
        width = about.get("width") if codes is None else codes.shape[0]
        if type(width) is not int or not 1 <= width <= _MOST_FEATURES:
            raise refusal
        widths.append(width)
    if widths[0] % 3 or sh_degree_of(widths[0] // 3) is None:
        raise refusal
    return n, widths[0], widths[1]
