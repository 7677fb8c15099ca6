"""docs/method.md: every function that it names exists, and no equation stands without one."""

import importlib
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "docs" / "method.md"
NAME = re.compile(r"`(sundae_ns(?:\.\w+)+)`")
EQUATION = re.compile(r"```math\n(.*?)```\n", re.DOTALL)


def resolve(name):
    """What a dotted name stands for; modules come before things of the same name in their package."""
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:cut]))
        except ModuleNotFoundError:
            continue
        for part in parts[cut:]:
            found = getattr(found, part)
        return found
    raise AttributeError(name)


def lonely(text):
    """Equations after which no function is named before the next equation or heading."""
    pieces = EQUATION.split(text)
    return [
        equation.strip()
        for equation, after in zip(pieces[1::2], pieces[2::2], strict=True)
        if not NAME.search(re.split(r"^#", after, maxsplit=1, flags=re.MULTILINE)[0])
    ]


@pytest.mark.parametrize("name", sorted(set(NAME.findall(PAGE.read_text(encoding="utf-8")))))
def test_every_function_exists(name):
    assert callable(resolve(name))


def test_every_equation_has_its_function():
    text = PAGE.read_text(encoding="utf-8")
    assert len(EQUATION.findall(text)) > 15
    assert lonely(text) == []


def test_what_github_cannot_render_is_not_there():
    text = PAGE.read_text(encoding="utf-8")
    # GitHub takes ```math blocks and single dollars; other ways stay as they are typed.
    assert "$$" not in text
    assert "\\[" not in text
    assert text.count("```math") == len(EQUATION.findall(text)) == text.count("```") / 2
    for equation in EQUATION.findall(text):
        assert equation.count("{") == equation.count("}")
        assert equation.count("\\left") == equation.count("\\right")
        assert equation.count("\\begin") == equation.count("\\end")
