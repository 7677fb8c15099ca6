"""Rewrite the tables of README.md and docs/*.md from benchmarks/results, and the list of the library's docstrings.

    python benchmarks/tables.py            # rewrite every table between its markers
    python benchmarks/tables.py quality    # print one table

A page holds the markers ``<!-- table: NAME -->`` and ``<!-- end of table -->``; the lines between them are made here.
Rows of runs.csv are those of a suite's results.csv.
"""

from __future__ import annotations

import argparse
import csv
import inspect
import json
import re
import textwrap
from collections.abc import Callable, Sequence
from itertools import pairwise, zip_longest
from pathlib import Path
from statistics import fmean
from typing import Any

import sundae_ns as sn
from harness.results import spread
from sundae_ns.core.tables import number, table

ROOT = Path(__file__).parents[1]
MB = 1e6
METHODS = {
    "splatfacto": "splatfacto, 30,000 steps",
    "sundae-auto": "**sundae**",
    "sundae-fast": "sundae-fast",
    "sundae": "sundae, fixed share",
    "mcmc": "3DGS-MCMC",
}
"""Arms of runs.csv that are shown, in the order of a table, by the names that readers see."""
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
MARKED = re.compile(r"(<!-- table: (?P<name>[\w-]+) -->\n).*?(<!-- end of table -->)", re.DOTALL)
FORMATS = {".spz": ".spz", ".sog": ".sog", ".sog theirs": ".sog by splat-transform", ".sundae": ".sundae"}
"""Packed formats in the order of a table, by the heads that readers see."""


def lines_of(name: str) -> list[dict[str, Any]]:
    """Rows of a results file, ``.jsonl`` or ``.csv``; cells of a CSV are text."""
    text = (ROOT / "benchmarks" / "results" / name).read_text(encoding="utf-8")
    if name.endswith(".jsonl"):
        return [json.loads(line) for line in text.splitlines()]
    return list(csv.DictReader(text.splitlines()))


def runs() -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Rows of runs.csv by capture and method, a row for each seed, in the order of :data:`METHODS`."""
    rows, groups = lines_of("runs.csv"), {}
    for scene in sorted({row["scene"] for row in rows}):
        for method in METHODS:
            own = [row for row in rows if (row["scene"], row["variant"]) == (scene, method)]
            if own := [row for row in own if method == "sundae-auto" or row["keep_ratio"] in ("", "1.0", "0.1")]:
                groups[scene, method] = own
    return groups


def quality() -> list[str]:
    """All methods on the captures: quality and size; :func:`training_time` has times, because suites share GPUs."""
    cells = {}
    for (scene, method), rows in runs().items():
        errors = ", ".join(spread([float(row[name]) for row in rows], n) for name, n in (("psnr", 2), ("ssim", 4)))
        keep = mean(rows, "keep_ratio") if rows[0]["keep_ratio"] else 1.0
        share = "" if keep == 1.0 else f" ({keep:.0%})"
        size = f"{number(mean(rows, 'primitives'), 0)}{share}, {number(mean(rows, 'bytes_total') / MB, 1)} MB"
        base = f"<br>head off: {number(mean(rows, 'psnr_base'), 2)}" if mean(rows, "bytes_head") else ""
        capture = f"{scene}, {rows[0]['resolution'].replace('x', ' x ')}"
        cells[capture, METHODS[method]] = f"{errors}<br>{size}{base}"
    return side_by_side(cells)


def side_by_side(cells: dict[tuple[str, str], str], head: str = "capture") -> list[str]:
    """A table of cells by capture and method, or other pairs: a row for each capture, a column for each method."""
    captures, methods = (list(dict.fromkeys(pair[i] for pair in cells)) for i in range(2))
    rows = [[capture, *(cells.get((capture, method), "") for method in methods)] for capture in captures]
    return table([head, *methods], rows, words=1)


def training_time() -> list[str]:
    """Seconds of whole trainings and milliseconds of frames, each with the error of what was trained."""
    cells = {}
    for line in lines_of("training_time.jsonl"):
        frame = f", {line['ms_frame']:.2f} a frame" if "ms_frame" in line else ""
        step = f"{1000 * line['train_s'] / line['steps']:.2f} ms a step{frame}"
        quality = ", ".join(number(line[name], digits) for name, digits in (("psnr", 2), ("ssim", 4)))
        arm = f"{line['arm']}, {number(line['steps'], 0)} steps, {gpu(line['gpu'])}"
        cells[line["scene"], arm] = f"{line['train_s']:.0f} s, {step}<br>{number(line['primitives'], 0)}; {quality}"
    return side_by_side(cells)


def gpu(name: str) -> str:
    return name.removeprefix("NVIDIA ").removesuffix(" 80GB HBM3")


def packing() -> list[str]:
    """What the default keeps of each capture, and its packs without and with a fine-tune, by means over seeds."""
    stock, made = runs(), []
    for capture, rows in defaults().items():
        count, head = mean(rows, "primitives"), "yes" if rows[0]["head"] == "yes" else ""
        theirs = _quality(stock[capture, "splatfacto"], "") if (capture, "splatfacto") in stock else ""
        cells = [capture, theirs, number(count, 0), head, _quality(rows, "")]
        packed, tuned = (mean(rows, f"{kind}_bytes") for kind in ("packed", "tuned"))
        cells += [number(packed / MB, 1), _quality(rows, "packed_")]
        cells += [number(tuned / MB, 2), number(8 * tuned / count, 0), _quality(rows, "tuned_")]
        made.append(cells)
    return table("capture,stock,kept,head,sundae,MB,packed,MB,bits,fine-tuned".split(","), made)


def defaults() -> dict[str, list[dict[str, Any]]]:
    """Rows of curve.csv that the default has chosen, one for each seed, by capture."""
    chosen: dict[str, list[dict[str, Any]]] = {}
    for row in (row for row in lines_of("curve.csv") if row["chosen"] == "yes"):
        chosen.setdefault(row["capture"], []).append(row)
    return chosen


def mean(rows: Sequence[dict[str, Any]], name: str) -> float:
    return fmean(float(row[name]) for row in rows)


def _quality(rows: Sequence[dict[str, Any]], kind: str) -> str:
    """PSNR, of what is kept with its spread, and SSIM over the seeds of a capture: ``31.51 ± 0.04, 0.928``."""
    decibels = number(mean(rows, f"{kind}psnr"), 2) if kind else spread([float(row["psnr"]) for row in rows], 2)
    return f"{decibels}, {mean(rows, f'{kind}ssim'):.3f}"


def formats() -> list[str]:
    """Stock runs in fp32 and in each packed format: MB of the whole file, PSNR in dB, and SSIM of the test views."""
    stock = stock_in(lambda row: f"{number(row['bytes'] / MB, 1)}, {number(row['psnr'], 2)}, {row['ssim']:.3f}")
    rows = [[capture, *(cells.get(kind, "") for kind in ("fp32", *FORMATS))] for capture, cells in stock.items()]
    return table(["capture", "fp32", *FORMATS.values()], rows, words=1)


def packed_headline() -> list[str]:
    """README's table of packed sizes: MB, and PSNR in dB, of stock splatfacto in each format, beside our default."""

    def cell(size: float, psnr: float) -> str:
        return f"{number(size / MB, 1)}, {number(psnr, 1)}"

    stock = stock_in(lambda row: cell(row["bytes"], row["psnr"]))
    rows = []
    for capture, found in defaults().items():
        ours = (cell(mean(found, f"{kind}_bytes"), mean(found, f"{kind}_psnr")) for kind in ("packed", "tuned"))
        rows.append([capture, *(stock.get(capture, {}).get(kind, "") for kind in FORMATS), *ours])
    kinds = list(FORMATS.values())
    return table(["capture", f"splatfacto, {kinds[0]}", *kinds[1:], "sundae", "fine-tuned"], rows, words=1)


def stock_in(cell: Callable[[dict[str, float]], Any]) -> dict[str, dict[str, Any]]:
    """A cell of stock splatfacto for each format, by capture, from means over the seeds."""
    groups: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for line in sorted(lines_of("formats.csv"), key=lambda line: str(line["capture"])):
        if line["method"] == "splatfacto":
            theirs = " theirs" if line["program"].startswith("splat-transform") else ""
            groups.setdefault(line["capture"], {}).setdefault(line["format"] + theirs, []).append(line)
    return {
        capture: {
            kind: cell({name: mean(lines, name) for name in ("bytes", "psnr", "ssim")}) for kind, lines in found.items()
        }
        for capture, found in groups.items()
    }


def equal_quality() -> list[str]:
    """Bytes of our smallest fine-tuned packs as a share of stock's .sog by splat-transform, at its PSNR and its SSIM.

    Packs of the default, and of a fixed share, are means of their seeds. Between measured fixed shares that enclose
    its quality, the bytes lie on a line, in their logarithm.
    """
    seeds: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in lines_of("curve.csv"):
        if row["tuned_bytes"]:
            key = (row["capture"], row["method"], "" if row["chosen"] == "yes" else row["share"])
            seeds.setdefault(key, []).append(row)
    packs: dict[str, list[dict[str, float]]] = {}
    for (capture, method, share), rows in seeds.items():
        cells = {name: mean(rows, f"tuned_{name}") for name in ("bytes", "psnr", "ssim")}
        packs.setdefault(capture, []).append({**cells, "fixed": method == "sundae" and share != ""})
    for line in lines_of("pack.jsonl"):
        if line.get("variant") == "sundae-fast" and line["finetune_steps"]:
            cells = {"bytes": line["bytes"], "psnr": line["psnr_packed"], "ssim": line["ssim_packed"]}
            packs[line["run"]].append({**cells, "fixed": False})
    theirs = {capture: kinds[".sog theirs"] for capture, kinds in stock_in(dict).items() if ".sog theirs" in kinds}
    lines = []
    for name in ("psnr", "ssim"):
        shares = [_least_bytes(packs[capture], name, sog[name]) / sog["bytes"] for capture, sog in theirs.items()]
        lines.append([f"at its {name.upper()}", *(f"1/{1 / share:.0f}" for share in [*shares, fmean(shares)])])
    return table([".sundae / .sog", *theirs, "mean"], lines, words=1)


def _least_bytes(packs: Sequence[dict[str, float]], metric: str, aim: float) -> float:
    """Bytes of the smallest pack that reaches a metric, measured or on a line between neighbouring fixed shares."""
    sizes = [pack["bytes"] for pack in packs if pack[metric] >= aim]
    fixed = sorted((pack for pack in packs if pack["fixed"]), key=lambda pack: pack["bytes"])
    for less, more in pairwise(fixed):
        if less[metric] < aim <= more[metric]:
            part = (aim - less[metric]) / (more[metric] - less[metric])
            sizes.append(less["bytes"] ** (1 - part) * more["bytes"] ** part)
    return min(sizes)


def multi_gpu() -> list[str]:
    """Training on one and several GPUs."""
    heads = ["field", "GPUs", "Gaussians", "images a second", "PSNR, dB", "MiB of a GPU, at most"]
    rows, above = [], ""
    digits = {"primitives": 0, "images_per_s": 1, "psnr": 2, "peak_mib": 0}
    for line in lines_of("multi_gpu.csv"):
        field = line["field"].partition(" to ")[0]
        figures = (number(float(line[name]), count) for name, count in digits.items())
        rows.append([field if field != above else "", f"{line['gpus']} {gpu(line['device'])}", *figures])
        above = field
    return table(heads, rows)


PRUNES = {
    ("decimate", "none", ""): "`--decimate`",
    ("decimate-adaptive", "none", ""): "`--decimate-adaptive`",
    ("pairs", "none", "cpu"): "`prune`, CPU",
    ("pairs", "none", "gpu"): "`prune`, GPU",
    ("pairs", "distill", "gpu"): "`distill`",
}
"""Rules, trainings and devices of prune.csv in the order of a table, by the heads that readers see."""


def prune() -> list[str]:
    """PSNR against the full field, and against the photographs, of scenes that were made small without photographs."""
    cells: dict[tuple[str, float], dict[tuple[str, str, str], str]] = {}
    for row in lines_of("prune.csv"):
        pair = f"{float(row['psnr_to_field']):.1f}, {float(row['psnr']):.1f}"
        device = "" if row["tool"] == "splat-transform" else "cpu" if row["device"] == "cpu" else "gpu"
        cells.setdefault((row["capture"], float(row["share"])), {})[row["rule"], row["training"], device] = pair
    captures = dict.fromkeys(capture for capture, _ in cells)
    made = []
    for capture in captures:
        halves, tenths = (cells.get((capture, share), {}) for share in (0.5, 0.1))
        made.append([capture, *("<br>".join([halves.get(name, "-"), tenths.get(name, "-")]) for name in PRUNES)])
    return table(["capture, 50% and 10% kept", *PRUNES.values()], made, words=1)


def sizes_asked() -> list[str]:
    """MB and PSNR of files by the size that was asked for; trained captures come last."""
    cells: dict[tuple[str, str], str] = {}
    rows = lines_of("sizes_asked.csv")
    for row in sorted(rows, key=lambda row: (row["source"], row["capture"], float(row["asked_mb"]))):
        asked = row["asked_mb"] + (" by training" if row["source"] == "trained" else "")
        cells[asked, row["capture"]] = f"{float(row['got_mb']):.3f}, {float(row['psnr']):.1f}"
    return side_by_side(cells, "MB asked")


def stability() -> list[str]:
    """Errors on hard scenes, image and worst gradient by rasteriser, and beside them on hard sets of points."""
    rows = lines_of("stability.csv")
    wrong = {row["case"] for row in rows if row["error"] != "0.0e+00"}
    exact = ", ".join(dict.fromkeys(row["case"] for row in rows if row["case"] not in wrong))
    scenes: dict[tuple[str, str], str] = {}
    points: dict[tuple[str, str], str] = {}
    for row in rows:
        if row["what"] == "response":
            points[row["case"], f"response, {row['device'].upper()}"] = row["error"] or "no responses"
        elif row["case"] in wrong:
            scenes[row["case"], row["what"]] = f"{row['error']}, {row['gradients']}"
        else:
            scenes[exact, row["what"]] = "0, 0"
    left, right = side_by_side(scenes, "scene"), side_by_side(points, "points")
    blank = "|" + "  |" * (right[0].count("|") - 1)
    return [one + other[1:] for one, other in zip_longest(left, right, fillvalue=blank)]


def others() -> list[str]:
    """What others reach: measured beside us, and published."""
    rows = lines_of("others.csv")
    return table(list(rows[0]), [list(row.values()) for row in rows])


GLUE = "\0"
"""Stands for a space at which no line ends."""


def library() -> list[str]:
    """The public names: a line with the signature and the first sentence of the docstring, then those of members."""
    lines: list[str] = []

    def add(indent: str, text: str) -> None:
        wrapper = textwrap.TextWrapper(120, f"{indent}- ", "  ", break_on_hyphens=False)  # four spaces would be code
        lines.extend(line.replace(GLUE, " ") for line in wrapper.wrap(text))

    for name in sn.__all__:
        value = getattr(sn, name)
        add("", f"`sn.{_signature(name, value)}`: {_first(value)}")
        members = vars(value).items() if value in (sn.Camera, sn.Scene) else ()
        for member, held in members:
            held = getattr(held, "__func__", held)  # of a class method
            if isinstance(held, property):
                add("  ", f"`{name}.{member}`: {_first(held)}")
            elif inspect.isfunction(held) and held.__doc__ and (member[0] != "_" or member == "__getitem__"):
                add("  ", f"`{name}.{_signature(member, held)}`: {_first(held)}")
    return lines


def _signature(name: str, value: Any) -> str:
    if isinstance(value, type) and value is not sn.PruneRule:  # which callers do not make by hand
        return name
    signature = inspect.signature(value)
    bare = [each.replace(annotation=each.empty) for each in signature.parameters.values()]  # docstrings say the types
    returned = "" if isinstance(value, type) else f" -> {str(signature.return_annotation).strip(chr(39))}"
    parameters = str(signature.replace(parameters=bare, return_annotation=signature.empty))
    return name + re.sub(r"\((self|cls)(, )?", "(", parameters, count=1) + returned


def _first(value: Any) -> str:
    """The first sentence of a docstring in one line, code in single backticks."""
    paragraph = " ".join((inspect.getdoc(value) or "").partition("\n\n")[0].split())
    sentence = re.split(r"(?<=\.) (?=[A-Z`])", paragraph, maxsplit=1)[0]
    sentence = re.sub(r":\w+:`[.~]?([^`]+)`", r"`\1`", sentence).replace("``", "`")
    return re.sub("`[^`]*`", lambda code: code[0].replace(" ", GLUE), sentence)  # a line must not begin with * or +


MAKERS = (quality, training_time, packing, formats, packed_headline, equal_quality, multi_gpu, prune)
TABLES: dict[str, Callable[[], list[str]]] = {
    make.__name__.replace("_", "-"): make for make in (*MAKERS, sizes_asked, others, stability, library)
}


def with_tables(text: str) -> str:
    """A page with its tables made anew."""
    return MARKED.sub(lambda found: found[1] + "\n".join(TABLES[found["name"]]()) + "\n" + found[3], text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", nargs="?", choices=TABLES, help="print this table, and rewrite nothing")
    options = parser.parse_args()
    if options.table:
        print("\n".join(TABLES[options.table]()))
        return
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        if with_tables(text) != text:
            page.write_text(with_tables(text), encoding="utf-8")
            print(f"wrote {page.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
