"""Changes of packed scenes behind valid checksums, for fuzz_packs.py."""

from __future__ import annotations

import hashlib
import json
import random
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sundae_ns.errors import SundaeError
from sundae_ns.storage.pack import container

Json = Any


@dataclass
class Pack:
    """A packed scene in parts; the checksums are made when it is written."""

    meta: dict[str, Json]
    bodies: list[bytes]
    """Stored bytes of the sections, in the header's order."""

    @classmethod
    def of(cls, content: bytes) -> Pack:
        (length,) = struct.unpack("<I", content[12:16])
        meta, at, bodies = json.loads(content[48 : 48 + length]), 48 + length, []
        for section in meta["sections"]:
            size = sum(section["parts"])
            bodies.append(content[at : at + size])
            at += size
        return cls(meta, bodies)

    def copy(self) -> Pack:
        return Pack(json.loads(json.dumps(self.meta)), list(self.bodies))

    def sealed(self) -> None:
        """State the checksums of the sections."""
        for section, body in zip(self.meta["sections"], self.bodies, strict=True):
            section["sha256"] = hashlib.sha256(body).hexdigest()

    def text(self) -> bytes:
        return json.dumps(self.meta).encode()


def with_header(text: bytes, bodies: Iterable[bytes]) -> bytes:
    """A file of a header and sections, with a valid checksum of the header."""
    return b"\x89SUNDAE\n" + struct.pack("<II", 3, len(text)) + hashlib.sha256(text).digest() + text + b"".join(bodies)


RAW = "@@RAW@@"
"""Stands in a header for text that is no valid JSON, or none that a writer makes."""
TEXTS = ["1e999", "-1e999", "NaN", "1" + 400 * "0", "1" + 5000 * "0", "1E0", "-0", "-0.0", "01", "1.", "+1", "1e-400"]
TEXTS += ['"\\ud800"', '"\\u0000"', "[" * 40 + "]" * 40, "[" * 2000 + "]" * 2000, '{"a": 1, "a": 2}', "// a\n1", "'a'"]
NUMBERS: list[Json] = [0, 1, 2, 3, 4, 5, 8, 9, 15, 16, 17, 24, 45, 72, 75, 255, 256, 257, 2**20, 2**28 - 1, 2**28]
NUMBERS += [-1, 2**31, 2**32, 2**53 + 1, 2**64, 0.5, 1.5, 1e-300, 1e-9, 9e-10, 1e9, 1.1e9, 1e28, 1.1e28, 1e30, 3.5e38]
NUMBERS += [1e39, 1e308, -1e30, 1e-45]
WORDS: list[Json] = ["", "nan", "1", "tiny", "large", "residual", "off", "auto", "features", "fp64", "classic", "black"]
WORDS += [
    "__proto__",
    "constructor",
    "toString",
    "transform",
    "xyz",
    "blocks",
    "channels",
    "|O",
    "<f4",
    "a\nb",
    "ü",
    "random",
]
OTHERS: list[Json] = [None, True, False, [], {}, [[]], [1, 2], [1e30, 1e30], {"codec": "transform"}, [["a", [1]]]]


def places(value: Json, path: tuple[Json, ...] = ()) -> Iterator[tuple[Json, ...]]:
    """Paths of all values in a header."""
    if path:
        yield path
    if isinstance(value, (dict, list)):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from places(inner, (*path, key))


def at(meta: Json, path: tuple[Json, ...]) -> Json:
    for key in path:
        meta = meta[key]
    return meta


def chosen_place(pack: Pack, rng: random.Random) -> tuple[Json, ...]:
    """A place of the header; places in the list of sections are many, and less than half of the choices."""
    paths = list(places(pack.meta))
    listed = rng.random() < 0.3
    return rng.choice([path for path in paths if (path[0] == "sections") == listed])


def other_value(value: Json, rng: random.Random) -> Json:
    """A value in place of another: near it, of its kind, or of any kind."""
    kind = rng.randrange(6)
    if type(value) in (int, float) and kind < 3:
        near = [value + 1, value - 1, 2 * value, -value, value / 3, float(value), value + 0.5]
        return rng.choice(near)
    if isinstance(value, list) and kind < 3:
        changed = list(value)
        if not changed:
            return [0]
        i, j = rng.randrange(len(changed)), rng.randrange(len(changed))
        act = rng.randrange(4)
        if act == 0:
            changed.append(changed[i])
        elif act == 1:
            del changed[i]
        elif act == 2:
            changed[i], changed[j] = changed[j], changed[i]
        else:
            changed = changed[:i] * 2
        return changed
    return rng.choice([rng.choice(NUMBERS), rng.choice(WORDS), rng.choice(OTHERS), RAW])


def change_value(pack: Pack, rng: random.Random) -> None:
    *front, last = chosen_place(pack, rng)
    place = at(pack.meta, tuple(front))
    place[last] = other_value(place[last], rng)


def change_keys(pack: Pack, rng: random.Random) -> None:
    """Remove, rename or add an entry of an object."""
    objects = [path for path in places(pack.meta) if isinstance(at(pack.meta, path), dict)]
    place = at(pack.meta, rng.choice([(), *objects]))
    keys = [key for key in place if key != "sections"]
    act = rng.randrange(3)
    if act == 0 and keys:
        del place[rng.choice(keys)]
    elif act == 1 and keys:
        place[rng.choice(WORDS)] = place.pop(rng.choice(keys))
    else:
        place[rng.choice([*WORDS, "step", "width", "trained_focal", "head"])] = rng.choice([*NUMBERS, *OTHERS])


def change_model(pack: Pack, rng: random.Random) -> None:
    """State another model: every option has few values that matter."""
    model = pack.meta["model"]
    head = model["head"] or {"mode": "residual", "size": "tiny", "pixel_unshuffle": 1, "num_features": 3}
    options = {**head, "precision": rng.choice(["fp32", "bf16", "fp8", None, 32])}
    name = rng.choice(["mode", "size", "pixel_unshuffle", "num_features", "precision"])
    options[name] = rng.choice([*WORDS, "tiny", "compact", "features", "residual", 1, 2, 3, 4, 13, 2.0, 3.0])
    focal = rng.choice([*NUMBERS, *NUMBERS, None, "1", True])
    model |= rng.choice(
        [
            {"head": rng.choice([options, None, {}])},
            {"trained_focal": rng.choice([[focal, focal], [focal], [1, 2, 3], [1, focal], focal])},
            {"sh_degree": rng.choice([0, 1, 2, 3, 4, 5, -1, 1.0, True])},
            {"background_color": rng.choice(WORDS)},
            {"rasterize_mode": rng.choice(WORDS)},
        ]
    )


def change_start(pack: Pack, rng: random.Random) -> None:
    """State another up axis or start view: wrong by a little, by much, or of another kind."""
    near: list[Json] = [0, 1, -1, 0.3, 0.95, 0.7, 1.05, 2, 1e-300, 1e30, -1e9, 1e9, 1.1e9, None, "1", True, RAW]
    up = [rng.choice(near) if rng.random() < 0.5 else float(i == 2) for i in range(3)]
    start = json.loads(json.dumps(pack.meta.get("start", {"pose": [], "intrinsics": [1, 1, 0, 0], "size": [9, 9]})))
    for part in start.values():
        row = rng.choice(part) if part and isinstance(part[0], list) else part
        if row and rng.random() < 0.4:
            row[rng.randrange(len(row))] = rng.choice([*near, *NUMBERS])
    if start["pose"] and rng.random() < 0.3:
        start["pose"][0], start["pose"][1] = start["pose"][1], start["pose"][0]
    pack.meta |= rng.choice([{"up": up}, {"start": start}, {"up": rng.choice(OTHERS)}, {"start": rng.choice(OTHERS)}])


def change_tensors(pack: Pack, rng: random.Random) -> None:
    """State other tensors of the head: twice, reordered, reshaped, renamed."""
    about = pack.meta["attributes"].get("head")
    if about is None:
        pack.meta["attributes"]["head"] = {"codec": "channels", "weights": 0, "tensors": rng.choice([[], [["a", [1]]]])}
        return
    tensors = about["tensors"]
    i, j = rng.randrange(len(tensors)), rng.randrange(len(tensors))
    act = rng.randrange(6)
    if act == 0:
        tensors[i][0] = tensors[j][0]
    elif act == 1:
        tensors.insert(j, json.loads(json.dumps(tensors[i])))
    elif act == 2:
        tensors[i], tensors[j] = tensors[j], tensors[i]
    elif act == 3:
        tensors[i][1] = rng.choice(
            [tensors[i][1][::-1], [*tensors[i][1], 1], tensors[i][1][:-1], tensors[j][1], [], [0]]
        )
    elif act == 4:
        del tensors[i]
    else:
        tensors[i][0] = rng.choice(WORDS)
    if rng.random() < 0.5:
        about["weights"] = sum(int(np.prod(shape)) for _, shape in tensors if len(shape) > 1)


def change_text(pack: Pack, rng: random.Random) -> bytes:
    """A header whose text is changed byte by byte, or is written in another way."""
    text = bytearray(pack.text())
    act = rng.randrange(5)
    if act == 0:
        for _ in range(rng.choice((1, 2, 8))):
            text[rng.randrange(len(text))] ^= 1 << rng.randrange(8)
    elif act == 1:
        start = rng.randrange(len(text))
        del text[start : start + rng.choice((1, 3, 40))]
    elif act == 2:
        start = rng.randrange(len(text))
        text[start:start] = rng.choice(
            (b" ", b"\n", b"\x00", b"\xef\xbb\xbf", b"\xff", b"1", b"e", b".", b"-", b'"', b"\\")
        )
    elif act == 3:
        others = (b"\xef\xbb\xbf" + text, text.decode().encode("utf-16"), text + b" \n\t", text + b"x", text[:-1])
        return bytes(rng.choice(others))
    else:
        return bytes(text.replace(b'"means"', b'"\\u006deans"').replace(b": ", b" :\r\n"))
    return bytes(text)


def corrupt(data: bytes, rng: random.Random) -> bytes:
    """Change some bytes."""
    changed, act = bytearray(data), rng.randrange(6)
    if not changed:
        return b"\0"
    start = rng.randrange(len(changed))
    if act < 2:
        for _ in range(rng.choice((1, 2, 10))):
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    elif act == 2:
        changed[start : start + 4] = rng.choice((bytes(4), b"\xff" * 4, rng.randbytes(4)))[: len(changed) - start]
    elif act == 3:
        del changed[start:]
    elif act == 4:
        changed += rng.randbytes(rng.choice((1, 2, 9)))
    else:
        changed[start:start] = changed[start : start + 7]
    return bytes(changed)


def change_stream(pack: Pack, rng: random.Random) -> None:
    """Change stored bytes of a section, and state their new length."""
    i = rng.randrange(len(pack.bodies))
    section = pack.meta["sections"][i]
    if not section["parts"]:
        return
    k = rng.randrange(len(section["parts"]))
    start = sum(section["parts"][:k])
    part = corrupt(pack.bodies[i][start : start + section["parts"][k]], rng)
    pack.bodies[i] = pack.bodies[i][:start] + part + pack.bodies[i][start + section["parts"][k] :]
    if section["shape"] == [section["parts"][k]] and rng.random() < 0.7:  # a stream, which is stored as it is
        section["shape"] = [len(part)]
    section["parts"][k] = len(part)


def change_deflated(pack: Pack, rng: random.Random) -> None:
    """Store planes as streams of other levels and strategies, some of them damaged.

    None ends early with bytes after it: Node before version 24 ignores such bytes, browsers and Python refuse them.
    """
    i = rng.randrange(len(pack.bodies))
    section, parts, at = pack.meta["sections"][i], [], 0
    size = int(np.prod(section["shape"])) * int(section["dtype"][2]) // max(len(section["parts"]), 1)
    for stored in section["parts"]:
        plane = pack.bodies[i][at : at + stored]
        at += stored
        if stored != size:
            plane = zlib.decompress(plane, wbits=-15)
        deflate = zlib.compressobj(rng.choice((0, 1, 6, 9)), wbits=-15, strategy=rng.choice((0, 1, 2, 3, 4)))
        stream = deflate.compress(plane) + deflate.flush()
        damaged = corrupt(stream, rng) if rng.random() < 0.3 else stream
        parts.append(stream if _ends_early(damaged) else damaged)
    pack.bodies[i] = b"".join(parts)
    section["parts"] = [len(part) for part in parts]


def _ends_early(stream: bytes) -> bool:
    inflate = zlib.decompressobj(wbits=-15)
    try:
        inflate.decompress(stream)
    except zlib.error:
        return False
    return bool(inflate.unused_data)


VALUES = [
    0,
    -0.0,
    1,
    -1,
    1e-45,
    1e-30,
    1e-9,
    9e-10,
    1e9,
    2e9,
    1e28,
    9e37,
    2e38,
    3.4e38,
    np.inf,
    -np.inf,
    np.nan,
    65536,
    65537,
]


def change_array(pack: Pack, rng: random.Random) -> None:
    """Put another array into a section: values at the limits, another shape or another dtype."""
    i = rng.randrange(len(pack.bodies))
    section = pack.meta["sections"][i]
    dtype, shape = section["dtype"], list(section["shape"])
    act = rng.randrange(4)
    if act == 0:
        side = rng.randrange(len(shape))
        shape[side] = rng.choice([0, 1, shape[side] + 1, max(shape[side] - 1, 0)])
    elif act == 1:
        dtype = rng.choice(["|u1", "<u2", "<u4", "<u8", "|i1", "<i2", "<f2", "<f4", "<f8"])
    count = int(np.prod(shape))
    if count > 1 << 16:
        return
    with np.errstate(all="ignore"):
        values = np.array([rng.choice(VALUES) if rng.random() < 0.5 else 1.0 for _ in range(count)], np.float64)
        if rng.random() < 0.5:
            values[:] = rng.choice(VALUES)
        array = values.astype(dtype).reshape(shape)
    planes = container.split_planes(array)
    section |= {"dtype": dtype, "shape": shape, "parts": [len(plane) for plane in planes]}
    pack.bodies[i] = b"".join(planes)


def change_values(pack: Pack, rng: random.Random) -> None:
    """Change a few values of an array of numbers."""
    numbers = [i for i, section in enumerate(pack.meta["sections"]) if section["dtype"] in ("<f4", "<f8", "<u4", "|i1")]
    i = rng.choice(numbers)
    content = with_header(pack.text(), pack.bodies)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        path.write_bytes(content)
        array = container.read_sections(path, container.read_header(path))[pack.meta["sections"][i]["name"]].copy()
    if array.size:
        flat = array.reshape(-1)
        with np.errstate(all="ignore"):
            for _ in range(rng.choice((1, 1, 3))):
                flat[rng.randrange(array.size)] = np.array(rng.choice(VALUES)).astype(array.dtype)
    planes = container.split_planes(array)
    pack.meta["sections"][i]["parts"] = [len(plane) for plane in planes]
    pack.bodies[i] = b"".join(planes)


def change_sections(pack: Pack, rng: random.Random) -> None:
    """Remove, repeat, rename or reorder whole sections."""
    sections, bodies = pack.meta["sections"], pack.bodies
    i, j = rng.randrange(len(sections)), rng.randrange(len(sections))
    act = rng.randrange(4)
    if act == 0:
        del sections[i], bodies[i]
    elif act == 1:
        sections.append(json.loads(json.dumps(sections[i])))
        sections[-1]["name"] = rng.choice([sections[i]["name"], "another/section", "cameras/poses", "head/levels"])
        bodies.append(bodies[i])
    elif act == 2:
        sections[i]["name"], sections[j]["name"] = sections[j]["name"], sections[i]["name"]
    else:
        sections[i], sections[j], bodies[i], bodies[j] = sections[j], sections[i], bodies[j], bodies[i]


CHANGES: list[Callable[[Pack, random.Random], None]] = [
    *(change_value, change_value, change_keys, change_model, change_tensors, change_tensors, change_start),
    *(change_stream, change_stream, change_deflated, change_array, change_values, change_values, change_sections),
]


def mutated(good: Pack, seed: int) -> bytes:
    """A file that differs from a good one by one or two changes; the seed chooses them."""
    rng = random.Random(seed)
    pack = good.copy()
    for change in rng.choices(CHANGES, k=rng.choice((1, 1, 1, 2))):
        try:
            change(pack, rng)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, SundaeError, zlib.error):
            continue  # the change before has left nothing to change
    try:
        pack.sealed()
    except (AttributeError, TypeError, ValueError):
        pass  # the list of sections is none
    text = change_text(pack, rng) if rng.random() < 0.08 else pack.text()
    text = text.replace(f'"{RAW}"'.encode(), rng.choice(TEXTS).encode())
    return with_header(text, pack.bodies)
