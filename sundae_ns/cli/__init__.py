"""The ``sundae`` command: tasks that nerfstudio's commands do not cover. Floor 10."""

from sundae_ns.cli.main import main as main
