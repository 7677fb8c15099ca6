"""Bounds of one view on a CPU, checked before memory is taken: a small file can describe a view of terabytes."""

from __future__ import annotations

from pathlib import Path

from sundae_ns.errors import MemoryExhaustedError

MOST_PER_TILE = 8192
"""Most primitives in a tile of 8 x 8 pixels, on average over the image.

Real scenes stay far below, from whatever place and through whatever lens: a closer camera sees larger primitives, but
fewer. A field of 504,143 primitives has at most 400, in 400 views from inside, outside and close by.
"""
PER_PRIMITIVE = 4
"""Pairs for each primitive beside these: a small one lies in up to four tiles, however small the image."""
ALWAYS = 1 << 22
"""Pairs beside these that any view may have, which take 40 MB."""
_NEGLIGIBLE = 1 << 28
"""Bytes that are taken without a look at the memory."""
_CONTROL_GROUP = Path("/sys/fs/cgroup")
_MEMORY = Path("/proc/meminfo")


def check_pairs(pairs: int, primitives: int, tiles: int, size: int, *, training: bool) -> None:
    """Refuse a view whose lists of tiles are longer than any scene needs, or than the memory.

    Args:
        pairs: of a tile and a primitive.
        primitives: visible ones.
        tiles: of the image.
        size: bytes that a pair takes.
        training: whether gradients are needed; then only the memory is a bound.

    Raises:
        MemoryExhaustedError: there are too many pairs.
    """
    if not training and pairs > MOST_PER_TILE * tiles + PER_PRIMITIVE * primitives + ALWAYS:
        raise MemoryExhaustedError(
            f"the view has {pairs // tiles:,} primitives in each tile of its image, but a real scene has less than "
            f"{MOST_PER_TILE:,}; choose another camera"
        )
    check_memory(size * pairs, f"{pairs:,} pairs of a tile and a primitive")


def check_memory(size: int, what: str) -> None:
    """Refuse what would take more than the memory that is available.

    Args:
        size: bytes.
        what: takes them, as the error names it.

    Raises:
        MemoryExhaustedError: it would take more.
    """
    if size < _NEGLIGIBLE:
        return
    available = available_memory()
    if available is not None and size > available:
        raise MemoryExhaustedError(
            f"{what} take {size / 1e9:,.1f} GB, but {available / 1e9:,.1f} GB are available; give a smaller image"
        )


def available_memory() -> int | None:
    """Bytes that this process can still take: of the machine, and of its control group; None if unknown."""
    found = []
    try:
        lines = dict(line.split(":", 1) for line in _MEMORY.read_text(encoding="utf-8").splitlines())
        found.append(1024 * int(lines["MemAvailable"].split()[0]))
    except (OSError, KeyError, ValueError):
        pass
    try:
        most, used, parts = (
            (_CONTROL_GROUP / f"memory.{name}").read_text(encoding="utf-8") for name in ("max", "current", "stat")
        )
        # The cache of files is given back when memory is needed.
        sizes = dict(line.split() for line in parts.splitlines())
        cached = int(sizes["active_file"]) + int(sizes["inactive_file"])
        found.append(max(int(most) - int(used) + cached, 0))
    except (OSError, KeyError, ValueError):  # no control group, one of another kind, or no limit
        pass
    return min(found, default=None)
