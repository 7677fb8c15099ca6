"""Scripts of ``benchmarks/``: their help, their commands, and the tables that they write into README and docs."""

from __future__ import annotations

import ast
import csv
import json
import re
import runpy
import shutil
import sys
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import tyro
from bench_jobs import measured
from csv_rows import read_rows
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.models.splatfacto import SplatfactoModel

from harness import stored, today
from harness.plan import Job
from harness.take_over import merged, take_over
from harness.today import fingerprints
from sundae_ns.graphs import build_graph

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "benchmarks"
RESULTS = FOLDER / "results"
SCRIPTS = sorted(path.name for path in FOLDER.glob("*.py"))
TABLE = "<!-- table: trials -->\n| old |\n<!-- end of table -->"


def run(monkeypatch: pytest.MonkeyPatch, name: str, *arguments: str) -> int:
    """Run a script as ``python benchmarks/NAME ARGUMENTS`` does; its exit code."""
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with pytest.raises(SystemExit) as caught:
        runpy.run_path(str(FOLDER / name), run_name="__main__")
    assert isinstance(caught.value.code, int)
    return caught.value.code


def loaded(monkeypatch: pytest.MonkeyPatch, name: str) -> dict[str, Any]:
    """Names of a script that was not started."""
    monkeypatch.syspath_prepend(str(FOLDER))
    return runpy.run_path(str(FOLDER / name))


def test_they_are_few() -> None:
    assert 0 < len(SCRIPTS) <= 25


@pytest.mark.parametrize("name", SCRIPTS)
def test_help(name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, name, "--help") == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: {name}")
    about = ast.get_docstring(ast.parse((FOLDER / name).read_text())) or ""
    assert f"python benchmarks/{name}" in about
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]
    for page in [about, *(page.read_text(encoding="utf-8") for page in pages)]:
        for words in re.findall(rf"python benchmarks/{name}([^`\n#;]*)", page):
            missing = [option for option in re.findall(r"--[a-z][\w-]*", words) if option not in text]
            assert not missing, words


# -------------------------------------------------------------------------------------------------------------- results


def test_results_are_small_and_can_be_read() -> None:
    for path in RESULTS.iterdir():
        text = path.read_text()
        # A row of a run with its command takes some 400 characters, and a suite has two dozen runs a capture.
        assert len(text) < (40_000 if path.name == "runs.csv" else 10_000), path.name
        if path.suffix == ".jsonl":
            assert all(isinstance(json.loads(line), dict) for line in text.splitlines()), path.name
    assert len(read_rows(RESULTS / "runs.csv")) >= 10


def test_commands_of_rows_are_ones_that_ns_train_takes() -> None:
    rows = [row for row in read_rows(RESULTS / "runs.csv") if row.command.startswith("ns-train ")]
    assert len(rows) >= 5
    # Rows of other captures and seeds have the same options.
    commands = {re.sub(r"(?<=--data )\S+|(?<=--machine\.seed )\S+", "7", row.command): row.steps for row in rows}
    for command, steps in commands.items():
        words = command.partition(";")[0].split()[1:]
        config = tyro.cli(AnnotatedBaseConfigUnion, args=words)  # type: ignore[arg-type]
        assert config.max_num_iterations == steps  # type: ignore[attr-defined]


# --------------------------------------------------------------------------------------------------------------- tables


def test_tables_of_all_pages_are_those_of_the_results(monkeypatch: pytest.MonkeyPatch) -> None:
    tables = loaded(monkeypatch, "tables.py")
    for page in tables["PAGES"]:
        text = page.read_text(encoding="utf-8")
        assert tables["with_tables"](text) == text, f"{page.name} is not current; run: python benchmarks/tables.py"


def test_every_table_can_be_made(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, make in loaded(monkeypatch, "tables.py")["TABLES"].items():
        heads, rule, *rows = make()
        assert rows, name
        assert {line.count("|") for line in (rule, *rows)} == {heads.count("|")}, name


def test_a_page_changes_between_its_markers_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    tables = loaded(monkeypatch, "tables.py")
    made = tables["with_tables"](f"before\n{TABLE}\nbetween\n{TABLE}\nafter\n")
    block = TABLE.replace("| old |", "\n".join(tables["trials"]()))
    assert made == f"before\n{block}\nbetween\n{block}\nafter\n"
    assert tables["with_tables"](made) == made
    assert tables["with_tables"]("| a |\n") == "| a |\n"
    with pytest.raises(KeyError, match="no-such-table"):
        tables["with_tables"](TABLE.replace("trials", "no-such-table"))


def today_of(row: dict[str, Any], arm: str) -> bool:
    """Whether a line of results has the fingerprint that its arm has today."""
    return row.get("fingerprint", "") in fingerprints(row.get("variant", arm), float(row.get("keep_ratio") or 0.1))


def test_rows_of_earlier_defaults_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    tables = loaded(monkeypatch, "tables.py")
    # A row of the tables is of all seeds, and of the share that is the default, or the arm's own.
    seeds: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in csv.DictReader((RESULTS / "runs.csv").open(newline="")):
        shown_method = row["variant"] in tables["METHODS"] and row["variant"] not in tables["LEFT_OUT"]
        if shown_method and (row["keep_ratio"] in ("0.1", "0.13", "1.0") or row["variant"] == "sundae-auto"):
            seeds.setdefault((row["scene"], row["variant"]), []).append(row)
    compared = {scene for scene, variant in seeds if variant in ("sundae", "sundae-auto")}
    headless = {
        scene for (scene, variant), (row, *_) in seeds.items() if variant == "sundae" and row["bytes_head"] == "0"
    }
    again = {(scene, "sundae-no-head") for scene in headless}
    runs = {
        place: all(today_of(row, "") for row in rows)
        for place, rows in seeds.items()
        if place[0] in compared and place not in again
    }
    lines = {
        name: [json.loads(line) for line in (RESULTS / f"{name}.jsonl").read_text().splitlines()]
        for name in ("frames", "training_time")
    }
    # Of a training that was timed twice, the last line is shown.
    lines["training_time"] = list({(line["scene"], line["arm"]): line for line in lines["training_time"]}.values())
    shown = {
        "quality": list(runs.values()),
        "speed": [today_of(line, "") for line in lines["frames"]],
        "training-time": [
            today_of(line, tables["TIMED"].get(line["arm"], line["arm"])) for line in lines["training_time"]
        ],
    }
    chosen: dict[str, list[bool]] = {}
    for row in csv.DictReader((RESULTS / "curve.csv").open(newline="")):
        if row["chosen"] == "yes":
            chosen.setdefault(row["capture"], []).append(today_of(row, "sundae-auto"))
    shown["packing"] = list(map(all, chosen.values()))
    marked = 0
    for name, of_today in shown.items():
        first, unmarked = "", []
        for row in tables["TABLES"][name]()[2:]:
            # An empty first cell is the one above.
            first = row.split("|")[1].strip() or first
            unmarked.append("earlier default" not in (row if name == "quality" else row + first))
        assert sorted(unmarked) == sorted(of_today), name
        marked += of_today.count(False)
    assert marked < sum(map(len, shown.values()))


def test_pages_are_not_current_after_a_default_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Then `python benchmarks/tables.py` marks the rows, until they are measured again."""
    tables = loaded(monkeypatch, "tables.py")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert tables["with_tables"](readme) == readme
    monkeypatch.setattr(today, "fingerprints", lambda arm, keep_ratio: frozenset())
    assert tables["with_tables"](readme) != readme
    assert all("earlier default" in row for row in tables["quality"]()[2:])


def test_a_suite_is_taken_over(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    tables = loaded(monkeypatch, "tables.py")
    results = shutil.copytree(RESULTS, tmp_path / "results")
    monkeypatch.setattr(stored, "RESULTS", results)
    written = []
    for seed, ratio, arm, kind in (
        *((seed, 0.1, "sundae", "whole") for seed in (42, 43, 44)),
        *[(42, 0.01, "sundae", "whole"), (42, None, "sundae-auto", "whole"), (42, 0.1, "band", "branch")],
    ):
        job = Job(f"fox-{arm}-{ratio}-{seed}", kind, "fox", arm, "/data/fox", "sundae", 30_000, seed, ratio)  # type: ignore[arg-type]
        (today, *_) = sorted(fingerprints(arm, ratio or 0.1))
        command = "ns-train sundae --data fox --pipeline.model.warm-start /else where/nerfstudio_models colmap"
        run = replace(measured(job), fingerprint=today, command=command, ms_head=0.0, gpu="NVIDIA X").as_json()
        packed = {"bytes": 1_000_000, "psnr": 26.5, "ssim": 0.8, "psnr_base": 26.5, "ssim_base": 0.8}
        tuned = {**packed, "bytes": 600_000} if arm.startswith("sundae") else None
        written.append({"job": asdict(job), "measured": run, "packed": packed, "tuned": tuned, "alone": True})
    del written[-1]["tuned"]  # as in results of earlier versions
    source = tmp_path / "results.jsonl"
    source.write_text("".join(json.dumps(line) + "\n" for line in written))
    before = read_rows(RESULTS / "runs.csv")
    take_over(source)

    rows = read_rows(results / "runs.csv")
    fox = [(row.variant, row.keep_ratio, row.seed) for row in rows if row.scene == "fox" and row.gpu == "NVIDIA X"]
    expected = [("band", 0.1, 42), *(("sundae", 0.1, seed) for seed in (42, 43, 44))]
    assert sorted(fox) == [*expected, ("sundae-auto", *fox[-2][1:])]
    stayed = [row for row in rows if row.gpu != "NVIDIA X"]
    measured_again = {("sundae", 0.1), ("band", 0.1)}
    seeds = {42, 43, 44}
    others = [
        row
        for row in before
        if row.scene != "fox"
        or (row.variant, row.keep_ratio) not in measured_again
        or (row.seed not in seeds and row.fingerprint in fingerprints(row.variant, row.keep_ratio or 0.1))
    ]
    # Trials choose another share in each run of a seed.
    others = [row for row in others if (row.scene, row.variant, row.seed) != ("fox", "sundae-auto", 42)]
    assert stayed == others != []
    text = (results / "runs.csv").read_text()
    assert "--pipeline.model.warm-start WARM_UP colmap" in text
    assert "/else where" not in text
    (row,) = [line for line in tables["TABLES"]["quality"]() if "26.10 ± 0.10" in line]  # the mean of three seeds
    assert "earlier default" not in row
    for name, count in (("speed", 3), ("training-time", 2)):
        made = [line for line in tables["TABLES"][name]() if "X |" in line]
        assert len(made) == count, name
    packs = [json.loads(line) for line in (results / "pack.jsonl").read_text().splitlines()]
    made = {line["bytes"]: line["finetune_steps"] for line in packs if line["bytes"] in (1_000_000, 600_000)}
    assert made == {1_000_000: 0}  # of the band rule; others are on the curve
    with (results / "curve.csv").open() as file:
        curve = [row for row in csv.DictReader(file) if row["packed_bytes"] == "1000000"]
    assert {row["capture"] for row in curve} == {"fox"}
    assert [(row["share"], row["seed"], row["chosen"], row["tuned_bytes"]) for row in curve] == [
        *(("None", "42", "yes", "600000"), ("0.1", "42", "no", "600000")),
        *(("0.1", "43", "no", "600000"), ("0.1", "44", "no", "600000"), ("0.01", "42", "no", "600000")),
    ]
    for name, make in tables["TABLES"].items():
        assert make()[2:], name


def test_a_mean_over_seeds_mixes_no_defaults() -> None:
    (today, *_) = sorted(fingerprints("sundae", 0.1))
    first, second, earlier, other = (
        {"scene": scene, "variant": "sundae", "keep_ratio": "0.1", "seed": str(seed), "fingerprint": fingerprint}
        for scene, seed, fingerprint in (("a", 42, today), ("a", 43, today), ("a", 44, "older"), ("b", 44, "older"))
    )
    places = ("scene", "variant", "keep_ratio", "seed")
    assert merged([second, earlier, other], [first], places) == [second, other, first]


def test_packed_formats_stand_side_by_side(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    tables = loaded(monkeypatch, "tables.py")
    monkeypatch.setattr(stored, "RESULTS", tmp_path)
    heads = "capture,method,format,program,bytes,psnr,ssim,primitives,seed,fingerprint,command\n"
    (ours, *_), (stock, *_) = (sorted(fingerprints(name, 0.1)) for name in ("sundae-auto", "splatfacto"))
    (tmp_path / "formats.csv").write_text(
        heads + f"fox,splatfacto,.sog,splat-transform 3.7.0,9000000,29.5,0.7,900,42,{stock},b\n"
        f"fox,splatfacto,.sundae,sundae_ns,8000000,29.0,0.6,900,42,{stock},c\n"
        f"fox,splatfacto,.sundae,sundae_ns,6000000,29.4,0.7,900,43,{stock},c\n"
        f"fox,splatfacto,.spz,sundae_ns,8000000,29.4,0.7,900,42,older,c\n"
    )
    columns = "capture,seed,chosen,fingerprint,packed_bytes,packed_psnr,tuned_bytes,tuned_psnr\n"
    (tmp_path / "curve.csv").write_text(
        columns + f"fox,42,yes,{ours},2000000,31.0,1200000,30.9\n"
        f"fox,43,yes,{ours},3000000,31.4,1600000,30.3\n"
        f"fox,42,no,{ours},4000000,31.0,,\n"
        "lion,42,yes,older,2000000,31.0,1000000,30.0\n"
    )
    assert [line.split(" | ") for line in tables["packed_headline"]()[2:]] == [
        ["| fox", "", "", "9.0, 29.5", "7.0, 29.2", "2.5, 31.2", "1.4, 30.6 |"],
        ["| lion, earlier default", "", "", "", "", "2.0, 31.0", "1.0, 30.0 |"],
    ]
    assert tables["formats"]()[-1] == "| fox |  |  |  | 9.0, 29.50, 0.700 | 7.0, 29.20, 0.650 |"


def test_bytes_at_equal_quality_are_measured_or_between_fixed_shares(monkeypatch: pytest.MonkeyPatch) -> None:
    least = loaded(monkeypatch, "tables.py")["_least_bytes"]
    packs = [
        {"bytes": 4e6, "psnr": 22.0, "fixed": True},
        {"bytes": 1e6, "psnr": 20.0, "fixed": True},
        {"bytes": 3e6, "psnr": 21.9, "fixed": False},
    ]
    assert least(packs, "psnr", 21.0) == pytest.approx(2e6)  # halfway in the logarithm
    assert least(packs, "psnr", 21.8) == 3e6
    assert least(packs, "psnr", 20.0) == 1e6
    with pytest.raises(ValueError, match="empty"):
        least(packs, "psnr", 22.1)


def test_the_curve_shows_todays_shares_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    today_at = {share: sorted(fingerprints("sundae", share))[0] for share in (0.1, 0.2)}
    rows = [
        {"method": method, "chosen": chosen, "share": str(share), "fingerprint": fingerprint}
        for method, chosen, share, fingerprint in (
            *(("sundae", "no", 0.2, today_at[0.2]), ("sundae", "no", 0.2, "older")),
            *(("sundae", "no", 0.4, "older"), ("sundae", "no", 0.1, today_at[0.1])),
            *(("sundae", "yes", 0.1, today_at[0.1]), ("sundae-no-head", "no", 0.1, today_at[0.1])),
        )
    ]
    shown = loaded(monkeypatch, "plot.py")["fixed_shares"](rows)
    assert [row["share"] for row in shown] == ["0.1", "0.2"]
    assert all(row["method"] == "sundae" and row["chosen"] == "no" for row in shown)


def test_plots(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    results, out = tmp_path / "results", tmp_path / "out"
    shutil.copytree(RESULTS, results)
    row = {"scene": "lion", "train_s": 80.0, "psnr": 31.5, "ssim": 0.93, "curve": [[2.0, 20.0, 0.6], [9.0, 25.0, 0.8]]}
    rows = [json.dumps({**row, "arm": arm}) + "\n" for arm in ("sundae", "splatfacto")]
    (results / "training_time.jsonl").write_text("".join(rows))
    monkeypatch.setattr(stored, "RESULTS", results)
    plots = loaded(monkeypatch, "plot.py")
    monkeypatch.setattr(sys, "argv", ["plot.py", "-o", str(out)])
    plots["main"]()
    assert {path.stem for path in out.iterdir()} == set(plots["PLOTS"])
    (panel,) = plots["plot_time"]().axes
    assert [line.get_label() for line in panel.lines[::2]] == ["sundae", "splatfacto"]
    assert panel.lines[0].get_ydata().tolist() == [20.0, 25.0, 31.5]


# ---------------------------------------------------------------------------------------------------------------- parts


class Stock(torch.nn.Module):
    """What a finished model of stock splatfacto offers, without its kernels: grey images."""

    get_gt_img = SplatfactoModel.get_gt_img
    composite_with_background = SplatfactoModel.composite_with_background
    _downscale_if_required = SplatfactoModel._downscale_if_required
    _get_downscale_factor = SplatfactoModel._get_downscale_factor
    device = torch.device("cpu")

    def get_outputs_for_camera(self, camera: Any) -> dict[str, torch.Tensor]:
        return {"rgb": torch.full((16, 16, 3), 0.5), "background": torch.ones(16, 16, 3)}


def test_a_training_of_stock_splatfacto_is_measured_too(monkeypatch: pytest.MonkeyPatch) -> None:
    grey, clear = torch.full((16, 16, 3), 0.6), torch.zeros(16, 16, 4)
    views = [(torch.zeros(1), {"image": image}) for image in (grey, clear)]  # a clear image is its background
    manager = SimpleNamespace(fixed_indices_eval_dataloader=views)
    trainer = SimpleNamespace(pipeline=SimpleNamespace(model=Stock(), datamanager=manager))
    decibels, similarity = loaded(monkeypatch, "bench_training.py")["quality"](trainer)
    assert decibels == pytest.approx((20 - 20 * np.log10(0.5)) / 2, abs=1e-4)
    assert 0.5 < similarity < 1
    assert trainer.pipeline.model.training


def test_parts_are_timed_beside_their_errors(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["rasterizers", "--primitives", "300", "--size", "24", "--repeats", "1"]
    monkeypatch.setattr(sys, "argv", ["bench_step.py", *words])
    loaded(monkeypatch, "bench_step.py")["main"]()
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["rasterizer"] for line in lines] == ["cpu", "reference"]
    for line in lines:
        assert all(0 < line[error] < 1e-3 for error in ("max_error", "gradient_error")), line
        assert all(value > 0 for name, value in line.items() if name.startswith("ms_"))


@pytest.mark.parametrize("sample", [0, 700])
def test_the_graph_is_timed_beside_its_errors(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], sample: int
) -> None:
    names = ["field", "clusters", "duplicates", "uniform"]
    words = [
        "--points",
        "4000",
        "--repeats",
        "2",
        "--device",
        "cpu",
        "--sample",
        str(sample),
        "--distributions",
        *names,
    ]
    monkeypatch.setattr(sys, "argv", ["bench_graph.py", *words])
    loaded(monkeypatch, "bench_graph.py")["main"]()
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["distribution"] for line in lines] == names
    keys = json.loads((RESULTS / "graph.jsonl").read_text().splitlines()[0]).keys()
    for line in lines:
        assert line.keys() == keys
        assert line["index_mismatches"] == 0
        assert line["response_rel_error"] < 1e-6
        assert all(line[name] > 0 for name in ("seconds", "graph_seconds", "response_seconds"))
        assert (line["reference_seconds"] is None) == (line["speedup"] is None) == (sample > 0)


def test_wrong_neighbours_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = loaded(monkeypatch, "bench_graph.py")
    points = bench["cluster_points"](500, np.random.default_rng(0))
    found = build_graph(torch.from_numpy(points), num_neighbors=bench["NEIGHBORS"]).indices.numpy()
    rows = np.arange(0, 500, 2)
    assert bench["compare_with_scipy"](points, found, rows)[1] == 0
    found[4, 0] = 4  # the point itself
    found[6, 0] = found[6, 1]  # one point twice
    found[8, 0] = next(i for i in range(500) if i not in {8, *found[8]})  # a point farther away
    found[9] = 9  # in no compared row
    assert bench["compare_with_scipy"](points, found, rows)[1] == 3


# -------------------------------------------------------------------------------------------------------------- mutants


def test_rooms_of_mutants_name_modules_and_tests_that_exist() -> None:
    tree = ast.parse((FOLDER / "mutants.py").read_text())
    rooms = next(
        node.value
        for node in tree.body
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "ROOMS"
    )
    assert isinstance(rooms, ast.Dict)
    for value in rooms.values:
        assert isinstance(value, ast.Call)
        modules, tests, *functions = (ast.literal_eval(argument) for argument in value.args)
        found = [path for glob in modules for path in (ROOT / "sundae_ns").glob(glob)]
        assert all(list((ROOT / "sundae_ns").glob(glob)) for glob in modules), modules
        assert all(list((ROOT / "tests").glob(glob)) for glob in tests), tests
        source = "\n".join(path.read_text() for path in found)
        for function in functions[0] if functions else ():
            assert f"\ndef {function}(" in source, function
