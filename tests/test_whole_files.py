"""Every file of the package is written beside its place and renamed, so that a killed command leaves no half of one."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WRITERS = {"write_text", "write_bytes", "save", "savefig", "tofile", "imwrite", "imsave", "writestr"}
FILES = {"partial", "content", "file", "buffer", "poster", "bundle"}
"""Names of files that will be renamed, of files opened from them, and of files in memory."""
ELSEWHERE = {
    "cli/demo.py": ["open(out / 'measure.log', 'w', encoding='utf-8')"],  # a log is read while it is written
    "cli/process.py": ["open(log, 'w', encoding='utf-8')"],
    "data/masks.py": ["scaled.save(folder / f'{image.stem}.png')"],  # in a folder that is renamed
    "evaluation/video.py": ["av.open(str(path), 'w', format='mp4', options={'movflags': 'faststart'})"],  # in cli/
    # In folders that are renamed, and a list that COLMAP reads at once.
    "poses/capture.py": ["(out / CLOUD).open('wb')"],
    "poses/reconstruction.py": ["(work / _LISTED).open('w', encoding='utf-8', newline='\\n')"],
    "poses/video.py": ["name.open('wb')"],
    "storage/run_folder.py": ["(run / LOCK).open('a+', encoding='utf-8')"],  # a lock stays
    "training/pruning.py": ["run.save()"],  # checkpoints
}
"""Calls that write in another way, by module."""


def direct_writes(source: str) -> Iterator[str]:
    """Calls that write into a file which is not renamed afterwards."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        method = isinstance(node.func, ast.Attribute)
        name = node.func.attr if isinstance(node.func, ast.Attribute) else ast.unparse(node.func)
        words = [ast.unparse(word) for word in node.args]
        if isinstance(node.func, ast.Attribute):
            words.append(ast.unparse(node.func.value))
        values = [*node.args, *(word.value for word in node.keywords)]
        modes = [value.value for value in values if isinstance(value, ast.Constant) and isinstance(value.value, str)]
        opens = name == "open" and any(len(mode) < 4 and set("wax+") & set(mode) for mode in modes)
        if (opens or (method and name in WRITERS)) and not FILES & set(words):
            yield ast.unparse(node)


@pytest.mark.parametrize(
    "source",
    [
        "path.write_text('a')",
        "open(path, 'w')",
        "path.open(mode='ab')",
        "image.save(path)",
        "figure.savefig(out / 'a')",
    ],
)
def test_it_would_be_noticed(source: str) -> None:
    assert list(direct_writes(source)) == [source]


def test_the_package_writes_no_file_in_place() -> None:
    found = {}
    for path in (ROOT / "sundae_ns").rglob("*.py"):
        calls = list(direct_writes(path.read_text(encoding="utf-8")))
        if calls:
            found[path.relative_to(ROOT / "sundae_ns").as_posix()] = calls
    assert found == ELSEWHERE
