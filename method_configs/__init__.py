"""The methods that ``ns-train`` lists; every entry point of the package points here.

Keep this import light, and free of ``nerfstudio.configs.method_configs``: entry points are loaded while that module is
half imported, and an error here would break every ``ns-*`` command.
"""

from sundae_ns.errors import show_in_one_line
from sundae_ns.method_configs.sundae import (
    sundae,
    sundae_1,
    sundae_30,
    sundae_50,
    sundae_80,
    sundae_100,
    sundae_auto,
    sundae_continuous,
    sundae_paper,
    sundae_tiny,
)

# nerfstudio's commands have no place of their own for this, and all of them load the plug-in.
show_in_one_line()

__all__ = [
    "sundae",
    "sundae_1",
    "sundae_30",
    "sundae_50",
    "sundae_80",
    "sundae_100",
    "sundae_auto",
    "sundae_continuous",
    "sundae_paper",
    "sundae_tiny",
]
