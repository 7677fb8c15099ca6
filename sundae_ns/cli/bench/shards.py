"""Shards of a benchmark, for batch systems that run them side by side."""

from __future__ import annotations

from sundae_ns.errors import ConfigError


def parse_shard(shard: str) -> tuple[int, int]:
    """``"2/5"``, the second of five parts, as the index from 0 and the number of parts.

    Raises:
        ConfigError: it has another form.
    """
    part, _, parts = shard.partition("/")
    if not (part.isdecimal() and parts.isdecimal() and 1 <= int(part) <= int(parts)):
        raise ConfigError(f"{shard!r} is no shard: use i/n with i from 1 to n")
    return int(part) - 1, int(parts)
