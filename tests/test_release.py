"""The release: what the wheel holds, the version, and the files of pre-commit and of the workflows."""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import check_wheel
import pytest
import yaml

import sundae_ns

ROOT = Path(__file__).parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def parsed(path: Path) -> dict[str, Any]:
    found = yaml.safe_load(path.read_text())
    assert isinstance(found, dict)
    return found


def steps(name: str, job: str) -> list[dict[str, Any]]:
    return list(parsed(ROOT / ".github" / "workflows" / name)["jobs"][job]["steps"])


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return check_wheel.build(tmp_path_factory.mktemp("built"))


def test_the_wheel_holds_the_package_and_nothing_else(built: tuple[Path, Path]) -> None:
    _, wheel = built
    assert check_wheel.missing(wheel) == []
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (metadata,) = (archive.read(name).decode() for name in names if name.endswith(".dist-info/METADATA"))
        assert not [info.filename for info in archive.infolist() if info.external_attr >> 28 == 0o12], "links"
    assert {"sundae_ns/method_configs/__init__.py", "sundae_ns/data/demo_capture.zip"} <= names
    assert {name.partition("/")[0].removesuffix(".dist-info") for name in names} == {"sundae_ns", wheel.stem[:15]}
    assert f"\nVersion: {sundae_ns.__version__}\n" in metadata
    assert f"\nRequires-Python: {','.join(sorted(PROJECT['requires-python'].split(',')))}\n" in metadata


def test_the_sdist_holds_files_in_place_of_the_link(built: tuple[Path, Path]) -> None:
    with tarfile.open(built[0]) as archive:
        members = {member.name.partition("/")[2]: member for member in archive.getmembers()}
    assert members["sundae_ns/method_configs/sundae.py"].isfile()
    assert {"README.md", "LICENSE", "pyproject.toml"} <= set(members)
    assert not [name for name, member in members.items() if member.issym() or member.islnk()]


def test_a_file_that_the_wheel_lacks_is_found(built: tuple[Path, Path], tmp_path: Path) -> None:
    with zipfile.ZipFile(built[1]) as archive, zipfile.ZipFile(tmp_path / "a.whl", "w") as cut:
        for name in archive.namelist():
            if not name.endswith((".zip", "method_configs/sundae.py")):
                cut.writestr(name, "")
    lost = ["sundae_ns/data/demo_capture.zip", "sundae_ns/method_configs/sundae.py"]
    assert check_wheel.missing(tmp_path / "a.whl") == lost


def test_methods_import_from_the_root_of_the_repository() -> None:
    # The sources hide an installed wheel there. Not imported: that takes seconds, and check_wheel.py does it.
    code = "from importlib.util import find_spec; print(find_spec('sundae_ns.method_configs').origin)"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert Path(result.stdout.strip()) == ROOT / "sundae_ns" / "method_configs" / "__init__.py"


def test_one_version_everywhere() -> None:
    version = PROJECT["version"]
    assert sundae_ns.__version__ == version
    assert re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1] == version
    lowest, above = re.fullmatch(r">=(3\.\d+),<(3\.\d+)", PROJECT["requires-python"]).groups()
    minors = range(int(lowest[2:]), int(above[2:]))
    claimed = [word for word in PROJECT["classifiers"] if word.startswith("Programming Language :: Python ::")]
    assert claimed == [f"Programming Language :: Python :: 3.{minor}" for minor in minors]
    readme = (ROOT / "README.md").read_text()
    assert f"Python {' and '.join(f'3.{minor}' for minor in minors)}" in readme


def test_ci_runs_what_the_repository_runs() -> None:
    python = {"python-version": "3.11", "cache": "pip", "cache-dependency-path": "constraints.txt"}
    for name, job in (("ci.yml", "test"), ("publish.yml", "build")):
        used = [step.get("uses", "").partition("@")[0] for step in steps(name, job)]
        assert used[:2] == ["actions/checkout", "actions/setup-python"]
        assert steps(name, job)[1]["with"] == python
        assert [step["run"] for step in steps(name, job) if step.get("run") == "bash .ci/run"]
    elsewhere = parsed(ROOT / ".github" / "workflows" / "ci.yml")["jobs"]["elsewhere"]
    assert {name.partition("-")[0] for name in elsewhere["strategy"]["matrix"]["os"]} == {"windows", "macos"}
    assert steps("ci.yml", "elsewhere")[2]["with"] == python
    run = steps("ci.yml", "elsewhere")[-1]["run"]
    tests = re.findall(r"tests/\S+", run)
    assert [path for path in tests if not (ROOT / path).exists()] == []
    # yaml reads the key "on" as True.
    assert parsed(WORKFLOWS[1])[True] == {"push": {"tags": ["v*"]}}
    assert parsed(WORKFLOWS[1])["jobs"]["publish"]["needs"] == "build"


def test_a_release_checks_its_tag_and_its_wheel() -> None:
    commands = [step["run"] for step in steps("publish.yml", "build") if "run" in step]
    assert commands[-1] == ".venv/bin/python benchmarks/check_wheel.py --keep dist"
    for tag, code in ((f"v{PROJECT['version']}", 0), ("v0.0.9", 1)):
        result = subprocess.run(
            ["bash", "-ec", commands[0]], cwd=ROOT, env={"GITHUB_REF_NAME": tag, "PATH": "/usr/bin:/bin"}, check=False
        )
        assert result.returncode == code


def test_pre_commit_downloads_nothing() -> None:
    (local,) = parsed(ROOT / ".pre-commit-config.yaml")["repos"]
    assert local["repo"] == "local"
    assert {hook["language"] for hook in local["hooks"]} == {"system"}
    makefile = (ROOT / "Makefile").read_text().replace("$(BIN)", ".venv/bin")
    for hook in local["hooks"]:
        assert f"\t{hook['entry']}" in makefile


def pins(name: str) -> dict[str, str]:
    lines = (ROOT / name).read_text().splitlines()
    return dict(line.split("==") for line in lines if line and not line.startswith("#"))


def test_the_versions_for_older_drivers_differ_by_cuda_only() -> None:
    usual, older = pins("constraints.txt"), pins("constraints-cuda12.txt")
    changed = {name for name in usual.keys() | older.keys() if usual.get(name) != older.get(name)}
    of_cuda = {name for name in changed if name.startswith(("nvidia-", "cuda-"))}
    assert changed - of_cuda == {"torch", "torchvision", "triton"}
    assert not [name for name in older if name.endswith("-cu13") or name.startswith("cuda-")]
    assert len([name for name in of_cuda if name.endswith("-cu12")]) > 10
