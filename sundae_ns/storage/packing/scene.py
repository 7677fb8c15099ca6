"""A scene in one file: field, head and cameras are sections of ``container``, all else is in its header.

``docs/formats.md`` lists the names, shapes and error bounds of all sections.
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
from sundae_ns.storage.packing import container, quantize, transform
from sundae_ns.storage.packing.codecs import Codecs, as_matrix, fit
from sundae_ns.storage.packing.config import PackConfig
from sundae_ns.storage.packing.container import Array
from sundae_ns.storage.packing.quantize import Blocks

CAMERAS = {"poses": ("<f4", (3, 4)), "intrinsics": ("<f8", (4,)), "sizes": ("<u4", (2,))}
"""dtype and shape, after ``[M, ...]``, of the arrays of M cameras: camera-to-world with OpenGL axes in the model's
coordinates; fx, fy, cx, cy in pixels; width and height in pixels."""
_MAX_FEATURES = 256


@dataclass(frozen=True, eq=False)
class Scene:
    """All that is needed to render a scene."""

    field: dict[str, Tensor]
    """See :mod:`sundae_ns.gaussians.parameters`; float32 on the CPU."""
    head: dict[str, Tensor] = default(default_factory=dict)
    """State of the head; empty without a head."""
    cameras: dict[str, Tensor] | None = None
    """Cameras by the names of :data:`CAMERAS`."""
    meta: dict[str, Any] = default(default_factory=dict)
    """JSON values: configuration of the model, coordinate frame, and other entries of the caller."""


class PackReport(NamedTuple):
    """Size of a packed scene."""

    primitives: int
    bytes: int
    """Bytes of the file."""
    sections: dict[str, int]
    """Bytes of each section, and of ``header``."""

    @property
    def bits(self) -> dict[str, float]:
        """Bits per primitive of each attribute, and of ``head``, ``cameras`` and ``header``."""
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
        features.ndim == 2 and len(features) == n and 1 <= features.shape[1] <= _MAX_FEATURES
    ):
        raise PackError(f"features has shape {list(features.shape)}; it must be [{n}, 1 to {_MAX_FEATURES}]")
    known = {name: params[name].float() for name in (*SPLAT_NAMES, FEATURES) if name in params}
    broken = n - int(finite_mask(known).sum())
    if broken:
        raise PackError(f"{broken} of {n} primitives are not finite (NaN or infinite); prune the field first")


# ------------------------------------------------------------------------------------------------------------- encoding


def fit_scene(scene: Scene, config: PackConfig | None = None) -> tuple[Scene, Codecs]:
    """Fit codecs to a scene.

    Returns:
        The scene with its primitives in the stored order and with rounded positions, and the codecs.

    Raises:
        ConfigError: an option is invalid.
        PackError: the field has no primitives, wrong shapes or values that are not finite.
    """
    config = config or PackConfig()
    config.validate()
    _check(scene.field)
    field, codecs = fit(scene.field, scene.head, config)
    return replace(scene, field=field), codecs


def write_scene(path: Path, scene: Scene, config: PackConfig | None = None) -> PackReport:
    """Pack a scene into one file: :func:`fit_scene`, then :func:`write_fitted`."""
    return write_fitted(path, *fit_scene(scene, config))


def write_fitted(path: Path, scene: Scene, codecs: Codecs) -> PackReport:
    """Pack a scene, atomically, with codecs that were fitted to it before or after training with rounding.

    Args:
        scene: primitives in the order of :func:`fit_scene`. Its positions are ignored; the codecs hold them.

    Raises:
        PackError: values are not finite, or the codecs do not fit the scene.
        StorageError: the disk is full or not writable.
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
    for name, (entry, parts) in encoded.items():
        about[name] = entry
        arrays |= {f"{name}/{part}": array for part, array in parts.items()}
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
    """Sections of a file; each is checked before use."""

    def __init__(self, path: Path, header: container.Header, arrays: Mapping[str, Array]) -> None:
        self.path = path
        self.meta = header.meta
        self.arrays = arrays

    def refuse(self, reason: str) -> PackError:
        return PackError(f"{self.path} is not a valid scene ({reason}); pack it again")

    def section(self, name: str, dtypes: tuple[str, ...], shape: tuple[int | None, ...]) -> Array:
        """A finite array with one of the dtypes and the shape, in which None matches any length."""
        array = self.arrays.get(name)
        fits = array is not None and array.dtype.str in dtypes and len(array.shape) == len(shape)
        if array is None or not fits or any(w is not None and w != s for w, s in zip(shape, array.shape)):
            raise self.refuse(f"{name} is missing or has another shape")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise self.refuse(f"{name} has values that are not finite")
        return array

    def about(self, name: str, codecs: tuple[str, ...]) -> dict[str, Any]:
        """The header's entry of an attribute, with one of the codecs."""
        attributes = self.meta.get("attributes")
        entry = attributes.get(name) if isinstance(attributes, dict) else None
        if not isinstance(entry, dict) or entry.get("codec") not in codecs:
            raise self.refuse(f"its header has no valid codec for {name}")
        return entry

    def number(self, about: Mapping[str, Any], key: str, minimum: int, maximum: int) -> int:
        """A whole number from ``minimum`` to ``maximum``."""
        value = about.get(key)
        if not isinstance(value, int) or isinstance(value, bool) or not minimum <= value <= maximum:
            raise self.refuse(f"{key} is not one of {minimum} to {maximum}")
        return value

    def numbers(self, about: Mapping[str, Any], key: str, count: int) -> NDArray[np.float64]:
        """A list of ``count`` numbers within the range of float32."""
        value = about.get(key)
        if not isinstance(value, list) or len(value) != count or not all(type(v) in (int, float) for v in value):
            raise self.refuse(f"{key} is not a list of {count} numbers")
        try:
            array = np.array(value, np.float64)
        except OverflowError:
            array = np.array([np.inf])
        # A grid has up to 2^16 steps and a transform adds several; the sums must stay finite in float32.
        if not (np.abs(array) < np.finfo(np.float32).max / 2**20).all():
            raise self.refuse(f"{key} has values beyond float32")
        return array

    def places(self, name: str, limit: int) -> Array:
        """A section of indices below ``limit``."""
        array = self.section(name, ("<u4",), (None,))
        if len(array) and int(array.max()) >= limit:
            raise self.refuse(f"{name} has an index outside of the field")
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
    return quantize.dequantize_rotations(codes, reader.section("quats/largest", ("|u1",), (-(-n // 4),)), bits)


def _code(bits: int) -> str:
    return "|u1" if bits <= 8 else "<u2"


def _decode_uniform(reader: _Reader, name: str, n: int, width: int) -> NDArray[np.float32]:
    about = reader.about(name, ("uniform",))
    bits = reader.number(about, "bits", 4, 16)
    codes = reader.section(f"{name}/codes", (_code(bits),), (width, n))
    if about.get("differences") is True:
        if width != 3:
            raise reader.refuse(f"{name} does not have three channels")
        codes = np.stack([codes[0] + codes[1], codes[1], codes[2] + codes[1]])
    places = reader.places(f"{name}/places", width * n)
    exceptions = reader.section(f"{name}/exceptions", ("<f4",), (len(places),))
    low, step = reader.numbers(about, "low", width), reader.numbers(about, "step", width)
    return quantize.dequantize(codes, low, step, places, exceptions)


def _decode_rest(reader: _Reader, n: int, width: int) -> NDArray[np.float32]:
    about = reader.about("features_rest", ("transform",))
    (step,) = reader.numbers({"step": [about.get("step")]}, "step", 1)
    codes = reader.section("features_rest/codes", ("|i1", "<i2"), (width, n))
    basis = reader.section("features_rest/basis", ("|i1",), (width * width,)).reshape(width, width)
    rows = reader.places("features_rest/rows", n)
    exact = reader.section("features_rest/exact", ("<f4",), (len(rows), width))
    return transform.restore(codes, basis, float(step), rows, exact)


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
            value = take("plain", plain, count)
        else:
            value = take("weights", weights, count)
        head[name] = torch.from_numpy(value.astype(np.float32).reshape(shape))
        if coded and len(shape) > 1:
            head[name] = quantize.weights_at(head[name], torch.from_numpy(take("steps", steps, shape[0]).copy()))
    return head


def _tensors(reader: _Reader, listed: Any) -> list[tuple[str, tuple[int, ...]]]:
    """Names and shapes of the head's tensors, as listed in the header."""
    if not isinstance(listed, list) or len(listed) > 10_000:
        raise reader.refuse("its header does not list the tensors of the head")
    tensors = []
    for entry in listed:
        valid = isinstance(entry, list) and len(entry) == 2 and isinstance(entry[0], str) and isinstance(entry[1], list)
        if not valid or len(entry[1]) > 5 or not all(type(side) is int and 0 < side < 1 << 28 for side in entry[1]):
            raise reader.refuse("a tensor of the head has an invalid shape")
        tensors.append((entry[0], tuple(entry[1])))
    return tensors


def _decode_cameras(reader: _Reader) -> dict[str, Tensor] | None:
    if "cameras/poses" not in reader.arrays:
        return None
    count = len(reader.arrays["cameras/poses"])
    arrays = {
        name: reader.section(f"cameras/{name}", (dtype,), (count, *shape)) for name, (dtype, shape) in CAMERAS.items()
    }
    if count and (int(arrays["sizes"].min()) < 1 or int(arrays["sizes"].max()) > 1 << 16):
        raise reader.refuse("a camera has an invalid image size")
    arrays["sizes"] = arrays["sizes"].astype(np.int64)
    return {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}


def read_scene(path: Path) -> Scene:
    """Unpack a file, without executing anything in it, and with memory bounded by its size.

    Raises:
        PackError: the file is missing, of another version, truncated, altered, or not a valid scene.
    """
    path = Path(path)
    header = container.read_header(path)
    n, width, features = _shape(path, header)
    container.check_ratio(path, 4 * n * (14 + width + features), header.size)
    reader = _Reader(path, header, container.read_sections(path, header))

    # Start with the largest jobs, so that the threads end together.
    jobs: dict[str, Callable[[], NDArray[np.float32]]] = {}
    if width:
        jobs["features_rest"] = partial(_decode_rest, reader, n, width)
    if features:
        jobs[FEATURES] = partial(_decode_uniform, reader, FEATURES, n, features)
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
    """Numbers of primitives, of SH values of degrees 1 and up, and of features, from the header alone.

    Raises:
        PackError: the header contradicts itself, or names a codec that is not supported.
    """
    refusal = PackError(f"{path} is not a valid scene (its header contradicts itself); pack it again")
    attributes, n = header.meta.get("attributes"), header.meta.get("primitives")
    if not isinstance(attributes, dict) or type(n) is not int or not 1 <= n < 1 << 28:
        raise refusal
    widths = []
    for name, codec in (("features_rest", "transform"), (FEATURES, "uniform")):
        about = attributes.get(name)
        if about is None:
            widths.append(0)
            continue
        if not isinstance(about, dict):
            raise refusal
        if about.get("codec") != codec:
            raise PackError(f"{path} stores {name} with a codec that is not supported; pack the run again")
        codes = header.sections.get(f"{name}/codes")
        if codes is None or not 1 <= codes.shape[0] <= _MAX_FEATURES:
            raise refusal
        widths.append(codes.shape[0])
    if widths[0] % 3 or sh_degree_of(widths[0] // 3) is None:
        raise refusal
    return n, widths[0], widths[1]
