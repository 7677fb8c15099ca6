"""The release: what the wheel holds, and the version."""

import re
import tarfile
import tomllib
import zipfile
from pathlib import Path

import check_wheel
import pytest

import sundae_ns

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    return check_wheel.build(tmp_path_factory.mktemp("built"))


def test_the_wheel_holds_the_package_and_nothing_else(built):
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


def test_the_sdist_holds_files_in_place_of_the_link(built):
    with tarfile.open(built[0]) as archive:
        members = {member.name.partition("/")[2]: member for member in archive.getmembers()}
    assert members["sundae_ns/method_configs/sundae.py"].isfile()
    assert {"README.md", "LICENSE", "pyproject.toml"} <= set(members)
    assert not [name for name, member in members.items() if member.issym() or member.islnk()]


def test_a_file_that_the_wheel_lacks_is_found(built, tmp_path):
    with zipfile.ZipFile(built[1]) as archive, zipfile.ZipFile(tmp_path / "a.whl", "w") as cut:
        for name in archive.namelist():
            if not name.endswith((".zip", "method_configs/sundae.py")):
                cut.writestr(name, "")
    lost = ["sundae_ns/data/demo_capture.zip", "sundae_ns/method_configs/sundae.py"]
    assert check_wheel.missing(tmp_path / "a.whl") == lost


def test_one_version_everywhere():
    version = PROJECT["version"]
    assert sundae_ns.__version__ == version
    assert re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1] == version
    lowest, above = re.fullmatch(r">=(3\.\d+),<(3\.\d+)", PROJECT["requires-python"]).groups()
    minors = range(int(lowest[2:]), int(above[2:]))
    claimed = [word for word in PROJECT["classifiers"] if word.startswith("Programming Language :: Python ::")]
    assert claimed == [f"Programming Language :: Python :: 3.{minor}" for minor in minors]
    assert f"Python {' and '.join(f'3.{minor}' for minor in minors)}" in (ROOT / "README.md").read_text()
