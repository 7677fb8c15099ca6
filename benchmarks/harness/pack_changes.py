"""Changes of packed scenes behind valid checksums, for fuzz_packs.py."""

from __future__ import annotations

import hashlib
import json
import random
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from typing import Any

from sundae_ns.core.errors import SundaeError

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


RAW = "@@RAW@@"
"""Stands in a header for text that is no valid JSON, or none that a writer makes."""
TEXTS = ["1e999", "-1e999", "NaN", "1" + 400 * "0", "1" + 5000 * "0", "1E0", "-0", "-0.0", "01", "1.", "+1", "1e-400"]
TEXTS += ['"\\ud800"', '"\\u0000"', "[" * 40 + "]" * 40, "[" * 2000 + "]" * 2000, '{"a": 1, "a": 2}', "// a\n1", "'a'"]
NUMBERS: list[Json] = [0, 1, 2, 3, 4, 5, 8, 9, 15, 16, 17, 24, 45, 72, 75, 255, 256, 257, 2**20, 2**28 - 1, 2**28]
NUMBERS += [-1, 2**31, 2**32, 2**53 + 1, 2**64, 0.5, 1.5, 1e-300, 1e-9, 9e-10, 1e9, 1.1e9, 1e28, 1.1e28, 1e30, 3.5e38]
NUMBERS += [1e39, 1e308, -1e30, 1e-45]
WORDS: list[Json] = "nan 1 tiny large residual off auto features fp64 classic black random xyz blocks |O <f4 ü".split()
WORDS += ["", "__proto__", "constructor", "toString", "transform", "channels", "a\nb"]
OTHERS: list[Json] = [None, True, False, [], {}, [[]], [1, 2], [1e30, 1e30], {"codec": "transform"}, [["a", [1]]]]


def places(value: Json, path: tuple[Json, ...] = ()) -> Iterator[tuple[Json, ...]]:
    """Paths of all values in a header."""
    if path:
        yield path
    if isinstance(value, (dict, list)):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from places(inner, (*path, key))


def other_value(value: Json, rng: random.Random) -> Json:
    """A value in place of another: near it, of its kind, or of any kind."""
    kind = rng.randrange(6)
    if type(value) in (int, float) and kind < 3:
        near = [value + 1, value - 1, 2 * value, -value, value / 3, float(value), value + 0.5]
        return rng.choice(near)
    if isinstance(value, list) and kind < 3:
        if not value:
            return [0]
        i, j = sorted((rng.randrange(len(value)), rng.randrange(len(value))))
        repeated, removed, doubled = [*value, value[i]], value[:i] + value[i + 1 :], value[:i] * 2
        swapped = list(value)
        swapped[i], swapped[j] = value[j], value[i]
        return rng.choice([repeated, removed, swapped, doubled])
    return rng.choice([rng.choice(NUMBERS), rng.choice(WORDS), rng.choice(OTHERS), RAW])


def change_value(pack: Pack, rng: random.Random) -> None:
    """Change one value; places in the list of sections are many, and less than half of the choices."""
    listed = rng.random() < 0.3
    *front, last = rng.choice([path for path in places(pack.meta) if (path[0] == "sections") == listed])
    place = reduce(getitem, front, pack.meta)
    place[last] = other_value(place[last], rng)


def change_keys(pack: Pack, rng: random.Random) -> None:
    """Remove, rename or add an entry of an object."""
    objects = [path for path in places(pack.meta) if isinstance(reduce(getitem, path, pack.meta), dict)]
    place = reduce(getitem, rng.choice([(), *objects]), pack.meta)
    keys = [key for key in place if key != "sections"]
    act = rng.randrange(3)
    if act == 0 and keys:
        del place[rng.choice(keys)]
    elif act == 1 and keys:
        place[rng.choice(WORDS)] = place.pop(rng.choice(keys))
    else:
        place[rng.choice([*WORDS, "step", "width", "trained_focal", "head"])] = rng.choice([*NUMBERS, *OTHERS])


def corrupt(content: bytes, rng: random.Random) -> bytes:
    """Change some bytes."""
    data, act = bytearray(content), rng.randrange(5)
    if act == 0 and data:
        del data[rng.randrange(len(data)) :]
    elif act == 1:
        data += bytes(rng.choice((1, 7, 64)))
    else:
        for _ in range(rng.choice((1, 3, 30)) if data else 0):
            data[rng.randrange(len(data))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
    return bytes(data)


def change_part(pack: Pack, rng: random.Random) -> None:
    """Change stored bytes of a part of a section, or its numbers behind their compression.

    No stream ends early with bytes after it: Node before version 24 ignores these, browsers and Python refuse them.
    """
    index = rng.randrange(len(pack.bodies))
    section, body = pack.meta["sections"][index], pack.bodies[index]
    part = rng.randrange(len(section["parts"]))
    start = sum(section["parts"][:part])
    stored, inflate = body[start : start + section["parts"][part]], zlib.decompressobj(wbits=-15)
    if rng.random() < 0.5:
        deflate = zlib.compressobj(rng.choice((0, 1, 6, 9)), wbits=-15)
        changed = deflate.compress(corrupt(inflate.decompress(stored), rng)) + deflate.flush()
    else:
        changed = corrupt(stored, rng)
        with suppress(zlib.error):
            inflate.decompress(changed)
        if inflate.unused_data:
            return
    pack.bodies[index] = body[:start] + changed + body[start + len(stored) :]
    if section["shape"] == [section["parts"][part]] and rng.random() < 0.7:  # stored as it is
        section["shape"] = [len(changed)]
    section["parts"][part] = len(changed)


def change_sections(pack: Pack, rng: random.Random) -> None:
    """Remove, repeat or exchange sections."""
    sections, act = pack.meta["sections"], rng.randrange(3)
    i, j = rng.randrange(len(sections)), rng.randrange(len(sections))
    for items in (sections, pack.bodies):
        if act == 0 and len(items) > 1:
            del items[i]
        elif act == 1:
            items.append(items[i])
        else:
            items[i], items[j] = items[j], items[i]


CHANGES: tuple[Callable[[Pack, random.Random], None], ...] = (
    *(change_value, change_value, change_value, change_keys),
    *(change_part, change_part, change_sections),
)


def mutated(good: Pack, seed: int) -> bytes:
    """A file that differs from a good one by one or two changes; the seed chooses them."""
    rng = random.Random(seed)
    pack = Pack(json.loads(json.dumps(good.meta)), list(good.bodies))
    for change in rng.choices(CHANGES, k=rng.choice((1, 1, 1, 2))):
        # The change before may have left nothing to change.
        with suppress(ArithmeticError, AttributeError, LookupError, TypeError, ValueError, SundaeError, zlib.error):
            change(pack, rng)
    with suppress(AttributeError, TypeError, ValueError):  # the list of sections may be none
        for section, body in zip(pack.meta["sections"], pack.bodies, strict=True):
            section["sha256"] = hashlib.sha256(body).hexdigest()
    text = json.dumps(pack.meta).encode().replace(f'"{RAW}"'.encode(), rng.choice(TEXTS).encode())
    start = b"\x89SUNDAE\n" + struct.pack("<II", 3, len(text)) + hashlib.sha256(text).digest()
    return b"".join([start, text, *pack.bodies])
