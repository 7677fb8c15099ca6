"""Build the wheel by way of an sdist, install it outside the repository, and use it; print one JSON line.

    python benchmarks/check_wheel.py                 # a few minutes on a CPU; --demo-steps 0 leaves the demo out
    python benchmarks/check_wheel.py --keep dist     # keeps sdist and wheel in this folder

The environment is fresh and holds only the wheel; its dependencies come from the environment that runs this script.
Every command runs in the repository's root, whose folder ``sundae_ns`` hides the wheel from ``python``, and elsewhere.
Exits with 1 and the reason if anything is missing.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import tomllib
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
BUILD = "import sys; from setuptools import build_meta; print(build_meta.build_sdist(sys.argv[1]))"
LOOK = """
import json, sys
from importlib.metadata import entry_points
import sundae_ns, sundae_ns.method_configs
from nerfstudio.configs.method_configs import all_methods
points = [p for p in entry_points(group="nerfstudio.method_configs") if p.value.startswith("sundae_ns.")]
print(json.dumps({
    "where": sundae_ns.__file__,
    "methods": sorted(p.name for p in points if p.load().config.method_name == p.name and p.name in all_methods),
}))
"""
PLY = "import sys, torch, sundae_ns as sn; p = torch.rand(200, 3); sn.save(sn.Scene.from_points(p, p), sys.argv[1])"
SCRIPT = """#!{python}
import sys
from nerfstudio.scripts.train import entrypoint
sys.exit(entrypoint())
"""


def run(*words: object, cwd: Path, **variables: str) -> str:
    """What a command prints, without the variables of this Python; ends the script if the command fails."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")} | variables
    command = [str(word) for word in words]
    result = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        output = f"{result.stdout}\n{result.stderr}"
        raise SystemExit(f"{' '.join(command)}\nfailed in {cwd} with {result.returncode}:\n{output}")
    return result.stdout


def expect(sound: bool, failure: str) -> None:
    if not sound:
        raise SystemExit(failure)


def tracked() -> list[str]:
    """Files and links of the working tree that git knows."""
    return run("git", "ls-files", "--deduplicate", cwd=ROOT).splitlines()


def build(folder: Path) -> tuple[Path, Path]:
    """Build an sdist of the tracked files in ``folder``, and a wheel of the sdist: paths of both."""
    # A copy: setuptools leaves a build folder beside its sources.
    for name in tracked():
        (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / "source" / name, follow_symlinks=False)
    sdist = folder / run(sys.executable, "-c", BUILD, folder, cwd=folder / "source").splitlines()[-1]
    here = ("--quiet", "--no-deps", "--no-build-isolation")
    run(sys.executable, "-m", "pip", "wheel", *here, "--wheel-dir", folder, sdist, cwd=folder)
    return sdist, next(folder.glob("*.whl"))


def missing(wheel: Path) -> list[str]:
    """Files of the package that a wheel lacks."""
    names = (name.replace("method_configs/", "sundae_ns/method_configs/", 1) for name in tracked())
    package = {name for name in names if name.startswith("sundae_ns/") and not (ROOT / name).is_dir()}
    with zipfile.ZipFile(wheel) as archive:
        return sorted(package - set(archive.namelist()))


def install(wheel: Path, clean: Path) -> None:
    """Make an environment with the wheel, whose dependencies are those of this Python."""
    venv.create(clean, with_pip=False, symlinks=True)
    python = clean / "bin" / "python"
    run(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", wheel, cwd=clean)
    (site,) = clean.glob("lib/python*/site-packages")
    lent = [path for path in sys.path if any(Path(path).glob("*.dist-info"))]
    (site / "lent.pth").write_text("\n".join(lent or [sysconfig.get_path("purelib")]))
    (clean / "bin" / "ns-train").write_text(SCRIPT.format(python=python))
    (clean / "bin" / "ns-train").chmod(0o755)


def use(clean: Path, cwd: Path, out: Path) -> list[str]:
    """Use the installed commands in a folder, and write to another; returns the methods that register."""
    python, sundae, train = (clean / "bin" / name for name in ("python", "sundae", "ns-train"))
    seen = json.loads(run(python, "-c", LOOK, cwd=cwd).splitlines()[-1])
    home = ROOT if cwd == ROOT else clean
    expect(Path(seen["where"]).is_relative_to(home), f"in {cwd}, sundae_ns is imported from {seen['where']}")
    run(sundae, "doctor", cwd=cwd)
    run(python, "-c", PLY, out / "some.ply", cwd=cwd)
    run(sundae, "prune", out / "some.ply", "-o", out / "pruned.ply", "--keep", "0.5", "--overwrite", cwd=cwd)
    expect(0 < (out / "pruned.ply").stat().st_size < (out / "some.ply").stat().st_size, "sundae prune dropped nothing")
    expect("sundae-tiny" in run(train, "--help", cwd=cwd, COLUMNS="200"), "ns-train --help lists no sundae-tiny")
    text = run(train, "sundae", "--help", cwd=cwd, COLUMNS="200")
    expect("--pipeline.model.pruning.keep-ratio" in text, "ns-train sundae --help lacks our options")
    return list(seen["methods"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--demo-steps", type=int, default=60, help="length of the demo's training; 0: no demo")
    parser.add_argument("--keep", type=Path, help="folder for sdist and wheel")
    options = parser.parse_args()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    methods = sorted(project["entry-points"]["nerfstudio.method_configs"])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sdist, wheel = build(folder)
        expect(not missing(wheel), f"{wheel.name} lacks {', '.join(missing(wheel))}")
        install(wheel, folder / "clean")
        for place in (folder, ROOT):
            found = use(folder / "clean", place, folder)
            expect(found == methods, f"in {place}, only {', '.join(found)} register")
        if options.demo_steps:
            sundae = folder / "clean" / "bin" / "sundae"
            text = run(sundae, "demo", folder / "demo", "--steps", options.demo_steps, cwd=folder)
            expect("PSNR" in text and (folder / "demo" / "scene.html").exists(), f"sundae demo printed {text}")
        if options.keep is not None:
            options.keep.mkdir(parents=True, exist_ok=True)
            for path in (sdist, wheel):
                shutil.copy(path, options.keep)
        about = {"bytes": wheel.stat().st_size, "python": sys.version.split()[0], "methods": len(methods)}
    print(json.dumps({"wheel": wheel.name, **about, "demo_steps": options.demo_steps}))


if __name__ == "__main__":
    main()
