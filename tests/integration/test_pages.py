"""The commands in README and docs run as they stand there, page by page; those of training up to their first step."""

import runpy
import shlex
import shutil
import sys
from functools import partial
from pathlib import Path

import pytest
from colmap_models import write_model
from PIL import Image

from sundae_ns.cli import main
from sundae_ns.scene.cameras import film_views

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
ELSEWHERE = {
    "run PHOTOS": "trains 30,000 steps after COLMAP; test_run.py runs it with fewer, and poses from elsewhere",
    "run walk.mp4": "the same of a video; cli/test_run.py reads its commands, data/test_reconstruct.py makes captures",
    "poses ": "takes minutes; data/test_reconstruct.py finds the poses of a still life",
    "train CAPTURE": "becomes ns-train, in place of this process; cli/test_train.py reads its command",
    "python benchmarks/suite.py": "trains every method on every capture; test_benchmarks.py trains one method",
    "view scene.sundae": "serves until Ctrl-C; cli/test_view.py serves a page, and opens and ends it",
    "ns-train sundae --machine.num-devices 2": "needs two GPUs; plugin/test_whole_runs.py trains on two",
}
"""Commands that do not run here, by how they start, with the reason and the test that covers them."""
NAMES = {"$RUN": "RUN", "capture": "CAPTURE", "...": "", "after.sundae": "scene.sundae"}
NAMES |= dict.fromkeys(("RUN_OR_PACK_OR_PLY", "FILE", "scene.ply", "before.ply"), "other.ply")
NAMES["Detail=#camera=..."] = "Detail=#camera=2"
SHORTER = {"--finetune": "2", "--view": "2", "--width": "32", "--height": "24", "--train-views": "6"}
"""Values that suit a small run and a small scene."""
MORE = {"prune": ["--num-cameras", "4"], "render": ["--width", "32"]}
"""Options that shorten commands of ``sundae`` further."""
OURS = ("sundae ", "python benchmarks/")


def lines_of(page, *programs):
    """Commands that start so, in indented blocks."""
    lines = page.read_text(encoding="utf-8").replace("\\\n", " ").splitlines()
    return [line.strip() for line in lines if line.startswith(tuple(f"    {program}" for program in programs))]


def elsewhere(line):
    """Entries of ``ELSEWHERE`` that a command belongs to."""
    return [start for start in ELSEWHERE if line.removeprefix("sundae ").startswith(start)]


def commands_of(page, *programs):
    for line in lines_of(page, *programs or OURS):
        if not elsewhere(line):
            words = [NAMES.get(word, word.replace("$RUN", "RUN")) for word in shlex.split(line, comments=True)]
            for option, value in SHORTER.items():
                if option in words:
                    words[words.index(option) + 1] = value
            yield [word for word in words if word] + MORE.get(words[1], [])


@pytest.mark.usefixtures("short_prunes", "short_distillation")
@pytest.mark.parametrize("page", [page for page in PAGES if list(commands_of(page))], ids=lambda page: page.name)
def test_commands_run_as_they_stand(page, tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sundae_ns.cli.render.film_views", lambda scene, **_: film_views(scene, seconds=1))
    shutil.copytree(tiny.folder, "RUN")
    shutil.copytree(tiny.scene, "CAPTURE")

    def run(program, *words):
        script = partial(runpy.run_path, str(ROOT / words[0]), run_name="__main__")
        monkeypatch.setattr(sys, "argv", [*words])
        with pytest.raises(SystemExit) as caught:
            script() if program == "python" else main(words)
        assert caught.value.code == 0, words

    run("sundae", "export", "RUN", "-o", "other.ply")
    commands = list(commands_of(page))
    if not any(words[1] == "pack" and "scene.sundae" in words for words in commands):  # then another page has made it
        run("sundae", "pack", "RUN", "-o", "scene.sundae")
    for words in commands:
        run(*words)


def test_nothing_is_left_out_without_need():
    left_out = [start for page in PAGES for line in lines_of(page, "") for start in elsewhere(line)]
    assert set(left_out) == set(ELSEWHERE)
    found = {words[1] for words in commands_of(PAGES[0])}
    assert {"doctor", "pack", "export", "prune", "compare"} <= found, "README has commands to run"
    programs = {line.split()[0] for page in PAGES for line in lines_of(page, "ns-")}
    assert programs == {"ns-train", "ns-eval", "ns-viewer"}, "tests below run these"


@pytest.fixture
def run_and_capture(tiny, tmp_path, monkeypatch):
    """A folder with the files that the pages name: a run, its capture with a COLMAP model, and a .ply."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(tiny.folder, "RUN")
    shutil.copytree(tiny.scene, "CAPTURE")
    shutil.copytree("CAPTURE/images", "CAPTURE/images_2")
    images = sorted(path.name for path in Path("CAPTURE/images").iterdir())
    for model in ("sparse/0", "colmap/sparse/0"):
        write_model(Path("CAPTURE", model), images, (48, 48))
    Path("CAPTURE/masks").mkdir()
    for name in images:
        Image.new("L", (48, 48), 255).save(Path("CAPTURE/masks", name).with_suffix(".png"))
    with pytest.raises(SystemExit):
        main(["export", "RUN", "-o", "other.ply"])


@pytest.mark.usefixtures("run_and_capture")
def test_commands_of_training_start(tiny, call_here, monkeypatch):
    Path("RUN/nerfstudio_models", tiny.checkpoint(tiny.steps - 1).name).unlink()  # a finished run is not resumed
    begun = []
    # Everything but the steps: options, capture, schedule, config.yml.
    monkeypatch.setattr("nerfstudio.scripts.train.launch", lambda config, **_: begun.append(config))
    commands = [words for page in PAGES for words in commands_of(page, "ns-train ")]
    assert len(commands) > 6
    for words in commands:
        call_here(*words)
        config = begun.pop()
        assert config.method_name == words[1]
        assert (config.get_base_dir() / "config.yml").is_file(), words


@pytest.mark.usefixtures("run_and_capture")
def test_commands_on_runs_run(call_here, monkeypatch):
    shown = []
    # The viewer never ends; test_viewer.py renders in it.
    monkeypatch.setattr("nerfstudio.scripts.viewer.run_viewer._start_viewer", lambda *run: shown.append(run[2]))
    commands = [words for page in PAGES for kind in ("ns-eval ", "ns-viewer ") for words in commands_of(page, kind)]
    assert len(commands) > 1
    for words in commands:
        Path("eval.json").unlink(missing_ok=True)
        call_here(*words)
        assert Path("eval.json").is_file() == (words[0] == "ns-eval")
    assert len(shown) == sum(words[0] == "ns-viewer" for words in commands)
