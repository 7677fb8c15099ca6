"""The methods that ``ns-train`` lists; all entry points of the package point here.

Keep this import light and free of ``nerfstudio.configs.method_configs``: nerfstudio loads entry points while that
module is half imported, and an error here breaks every ``ns-*`` command.
"""

from sundae_ns.core.errors import show_in_one_line
from sundae_ns.method_configs.sundae import *  # noqa: F403

# nerfstudio has no hook for this, but all of its commands load the plug-in.
show_in_one_line()
