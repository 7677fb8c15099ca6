"""Build the wheel, install it outside the repository, and use it: methods, doctor, demo; print one JSON line.

    python benchmarks/check_wheel.py                 # a few minutes on a CPU; --demo-steps 0 leaves the demo out

The environment is fresh and holds only the wheel; its dependencies come from the environment that runs this script.
Exits with 1 if anything is missing.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import sysconfig
import tempfile
import tomllib
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
LOOK = """
import json, sys
from importlib.metadata import entry_points
import sundae_ns, sundae_ns.method_configs
from nerfstudio.configs.method_configs import all_methods
points = [p for p in entry_points(group="nerfstudio.method_configs") if p.value.startswith("sundae_ns.")]
print(json.dumps({
    "where": sundae_ns.__file__,
    "methods": sorted(p.name for p in points if p.load().config.method_name == p.name and p.name in all_methods),
    "path": sys.path,
}))
"""
SCRIPT = """#!{python}
import sys
from nerfstudio.scripts.{module} import entrypoint
sys.exit(entrypoint())
"""


def run(*words: object, cwd: Path, **variables: str) -> str:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")} | variables
    result = subprocess.run(
        [str(word) for word in words], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    if result.returncode != 0:
        raise SystemExit(
            f"{' '.join(map(str, words))}\nfailed with {result.returncode}:\n{result.stdout}\n{result.stderr}"
        )
    return result.stdout


def packaged() -> set[str]:
    """Files of the package in git, by their names in a wheel."""
    listed = run("git", "ls-files", "sundae_ns", "method_configs", cwd=ROOT).split()
    return {name.replace("method_configs/", "sundae_ns/method_configs/", 1) for name in listed}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--demo-steps", type=int, default=60, help="length of the demo's training; 0: no demo")
    options = parser.parse_args()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    expected = sorted(project["entry-points"]["nerfstudio.method_configs"])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        wheel_options = ["--no-deps", "--no-build-isolation", "--wheel-dir", folder]
        # From a clone: setuptools leaves a build folder beside its sources.
        run("git", "clone", "--quiet", ROOT, folder / "source", cwd=folder)
        run(sys.executable, "-m", "pip", "wheel", *wheel_options, folder / "source", cwd=folder)
        (wheel,) = folder.glob("*.whl")
        with zipfile.ZipFile(wheel) as archive:
            missing = sorted(packaged() - set(archive.namelist()))

        clean = folder / "clean"
        venv.create(clean, with_pip=False, symlinks=True)
        python = clean / "bin" / "python"
        run(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", wheel, cwd=folder)
        (site,) = clean.glob("lib/python*/site-packages")
        lent = [path for path in sys.path if any(Path(path).glob("*.dist-info"))]
        (site / "lent.pth").write_text("\n".join(lent or [sysconfig.get_path("purelib")]))
        for command, module in (("ns-train", "train"), ("ns-eval", "eval")):
            (clean / "bin" / command).write_text(SCRIPT.format(python=python, module=module))
            (clean / "bin" / command).chmod(0o755)

        seen = json.loads(run(python, "-c", LOOK, cwd=folder).splitlines()[-1])
        inside = Path(seen["where"]).is_relative_to(clean) and str(ROOT) not in seen["path"]
        helps = "sundae-tiny" in run(clean / "bin" / "ns-train", "--help", cwd=folder, COLUMNS="200")
        doctor = subprocess.run([clean / "bin" / "sundae", "doctor"], cwd=folder, capture_output=True, check=False)
        demo = None
        if options.demo_steps:
            output = run(clean / "bin" / "sundae", "demo", "demo", "--steps", options.demo_steps, cwd=folder)
            demo = "PSNR" in output and (folder / "demo" / "comparison.png").exists()
        result = {
            "wheel": wheel.name,
            "bytes": wheel.stat().st_size,
            "files_missing": missing,
            "methods": len(seen["methods"]),
            "every_method_registers": seen["methods"] == expected,
            "imported_from_the_wheel": inside,
            "ns_train_lists_them": helps,
            "doctor_runs": doctor.returncode == 0,
            "demo_runs": demo,
        }
    print(json.dumps(result))
    sound = result["every_method_registers"] and inside and helps and result["doctor_runs"] and demo in (None, True)
    sys.exit(0 if sound and not missing else 1)


if __name__ == "__main__":
    main()
