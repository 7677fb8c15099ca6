"""The run that a command of nerfstudio opens, which may be a copy of the one that was trained."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

COMMANDS = ("ns-eval", "ns-render", "ns-export", "ns-viewer")
"""Commands that open a finished run; ns-train also has --load-config, and writes to the folder that it names."""
_OPTION = "--load-config"


def loaded_run(program: Sequence[str]) -> Path | None:
    """Folder of the run that a command opens by its ``config.yml``; None for other commands.

    Args:
        program: the command and its arguments, as in ``sys.argv``.
    """
    if not program or Path(program[0]).stem not in COMMANDS:
        return None
    values = [""]
    for word, following in zip(program, [*program[1:], ""], strict=True):
        name, equals, value = word.partition("=")
        if name.replace("_", "-") == _OPTION:
            values.append(value if equals else following)
    config = Path(values[-1])
    return config.absolute().parent if values[-1] and config.is_file() else None
