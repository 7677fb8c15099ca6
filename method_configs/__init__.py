"""The methods that ``ns-train`` lists; every entry point of the package points here.

Keep this import light, and free of ``nerfstudio.configs.method_configs``: entry points are loaded while that module is
half imported, and an error here would break every ``ns-*`` command.
"""

from sundae_ns.method_configs.sundae import (
    sundae,
    sundae_1,
    sundae_30,
    sundae_50,
    sundae_80,
    sundae_100,
    sundae_continuous,
    sundae_paper,
    sundae_tiny,
)

__all__ = [
    "sundae",
    "sundae_1",
    "sundae_30",
    "sundae_50",
    "sundae_80",
    "sundae_100",
    "sundae_continuous",
    "sundae_paper",
    "sundae_tiny",
]
