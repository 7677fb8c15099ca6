"""The ``sundae`` command: what nerfstudio's own commands do not cover. Floor 4."""

from sundae_ns.cli.main import main

__all__ = ["main"]
