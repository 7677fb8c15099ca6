"""Take the results of a suite over into the files of ``benchmarks/results``."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from harness import stored
from harness.job import config_of
from harness.plan import Job
from harness.stored import METHODS, lines_of
from harness.today import SHARE, is_of_today
from sundae_ns.evaluation import COLUMNS, csv_text
from sundae_ns.storage.pack import FINETUNE_STEPS

CURVE = {"sundae": "sundae", "sundae-auto": "sundae", "sundae-no-head": "sundae-no-head"}
"""Arms of curve.csv by the method in its rows."""
CHOSEN = "sundae-auto"
"""The arm whose share is chosen by trials, and differs from run to run."""


def take_over(results: Path) -> None:
    """Replace rows of runs.csv, curve.csv, frames, training times and packs by those of ``suite.py``.

    Other rows stay, but for earlier defaults at other seeds of what was measured. What curve.csv holds, packs and fixed
    shares, is in no other file.

    Args:
        results: ``results.jsonl`` of the suite.
    """
    found = [_rounded(json.loads(line)) for line in results.read_text(encoding="utf-8").splitlines()]
    measured = [
        {**result["measured"], "command": _public(result["measured"]["command"])}
        for result in found
        if not _on_curve(result) or (result["job"]["keep_ratio"] or SHARE) == SHARE
    ]
    rows = list(csv.DictReader(csv_text(measured).splitlines()))

    def placed(row: dict[str, Any]) -> dict[str, Any]:
        return {**row, "place": "chosen" if row["variant"] == CHOSEN else row["keep_ratio"]}

    old, new = (list(map(placed, lines)) for lines in (lines_of("runs.csv"), rows))
    _write("runs.csv", COLUMNS, _without(merged(old, new, ("scene", "variant", "place", "seed")), "place"))
    _write("curve.csv", list(lines_of("curve.csv")[0]), _curve(lines_of("curve.csv"), found))
    seed = found[0]["job"]["seed"]
    own = [r for r in found if r["job"]["seed"] == seed and (r["job"]["keep_ratio"] or SHARE) == SHARE]
    packs = [line for r in own if not _on_curve(r) for line in _pack_lines(r)]
    for name, lines, places in (
        ("frames.jsonl", [_frame_line(r) for r in own if r["measured"]["ms_head"] is not None], ("config",)),
        ("training_time.jsonl", [_training_line(r) for r in own if _is_timed(r)], ("scene", "arm")),
        ("pack.jsonl", packs, ("run", "variant", "finetune_steps")),
    ):
        kept = merged(lines_of(name), lines, places)
        (stored.RESULTS / name).write_text("".join(json.dumps(line) + "\n" for line in kept), encoding="utf-8")


def merged(old: Iterable[dict[str, Any]], new: Sequence[dict[str, Any]], places: Sequence[str]) -> list[dict[str, Any]]:
    """New lines after the old ones that stay: those of other places, and today's of other seeds.

    A mean over seeds would mix an earlier default with today's.
    """

    def at(line: dict[str, Any], names: Iterable[str]) -> tuple[Any, ...]:
        return tuple(line.get(name) for name in names)

    all_seeds = [place for place in places if place != "seed"]
    taken, measured = ({at(line, names) for line in new} for names in (places, all_seeds))

    def stays(line: dict[str, Any]) -> bool:
        if at(line, all_seeds) not in measured:
            return True
        return at(line, places) not in taken and is_of_today({"variant": line.get("arm", "sundae"), **line})

    return [*filter(stays, old), *new]


def _write(name: str, columns: Sequence[str], rows: Iterable[dict[str, Any]]) -> None:
    with (stored.RESULTS / name).open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _curve(old: list[dict[str, Any]], found: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of curve.csv with those of packed results, capture by capture: what the default chose, and fixed shares."""
    new = [_curve_line(result) for result in found if _on_curve(result)]

    def placed(row: dict[str, Any]) -> dict[str, Any]:
        if row["chosen"] == "yes":
            return {"variant": CHOSEN, "place": "chosen", **row}
        return {"place": tuple(row[name] for name in ("method", "prune_at", "share")), **row}

    rows = merged(map(placed, old), list(map(placed, new)), ("capture", "place", "seed"))
    captures = list(dict.fromkeys(row["capture"] for row in [*old, *new]))
    rows.sort(key=lambda row: (captures.index(row["capture"]), row["chosen"] == "no"))
    return _without(rows, "variant", "place")


def _without(rows: Iterable[dict[str, Any]], *names: str) -> list[dict[str, Any]]:
    return [{name: value for name, value in row.items() if name not in names} for row in rows]


def _on_curve(result: dict[str, Any]) -> bool:
    return bool(result["packed"]) and result["job"]["arm"] in CURVE


def _curve_line(result: dict[str, Any]) -> dict[str, Any]:
    job, run, packed, tuned = (result.get(name) or {} for name in ("job", "measured", "packed", "tuned"))
    full, config = run["configurations"][0]["mean"], config_of(Job(**job))
    model: Any = config.pipeline.model
    row = {
        **{"capture": run["scene"], "method": CURVE[job["arm"]], "prune_at": str(model.pruning.prune_at)},
        **{"share": str(run["keep_ratio"]), "primitives": run["primitives"], "packed_bytes": packed["bytes"]},
        **{"psnr": full["psnr"], "ssim": full["ssim"]},
        **{"packed_psnr": packed["psnr"], "packed_ssim": packed["ssim"]},
        **{f"tuned_{name}": tuned.get(name, "") for name in ("bytes", "psnr", "ssim")},
        **{"head": "yes" if run["bytes_head"] else "no", "seed": str(run["seed"])},
        **{"chosen": "yes" if job["arm"] == CHOSEN else "no", "seconds": run["train_s"] if _is_timed(result) else ""},
    }
    return {**row, "fingerprint": run["fingerprint"]}


def _public(command: str) -> str:
    """A command without the place of its warm-up on this machine."""
    return re.sub(r"(--pipeline\.model\.warm-start) .*?nerfstudio_models", r"\1 WARM_UP", command)


def _rounded(value: Any) -> Any:
    """Plain values with four decimals."""
    if isinstance(value, dict):
        return {name: _rounded(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [_rounded(inner) for inner in value]
    return round(value, 4) if isinstance(value, float) else value


def _is_timed(result: dict[str, Any]) -> bool:
    return result["job"]["kind"] == "whole" and result["measured"]["train_s"] is not None


def _common(result: dict[str, Any]) -> dict[str, Any]:
    """Entries of every line of a result."""
    run = result["measured"]
    full = run["configurations"][0]["mean"]
    share = {"keep_ratio": result["job"]["keep_ratio"], "fingerprint": run["fingerprint"]}
    return {"primitives": run["primitives"], "psnr": full["psnr"], "ssim": full["ssim"], **share}


def _frame_line(result: dict[str, Any]) -> dict[str, Any]:
    run = result["measured"]
    width, height = (int(side) for side in run["resolution"].split()[0].split("x"))
    full, base = run["configurations"][0], run["configurations"][-1]
    return {
        "config": f"{run['scene']}, {METHODS.get(run['variant'], run['variant']).replace('*', '')}",
        "variant": run["variant"],
        "device": run["gpu"],
        **{"width": width, "height": height, "precision": run["precision"]},
        **{"ms_frame": full["ms"], "ms_splat": base["ms"], "ms_head": run["ms_head"]},
        **_common(result),
    }


def _training_line(result: dict[str, Any]) -> dict[str, Any]:
    run = result["measured"]
    return {
        **{"arm": run["variant"], "scene": run["scene"], "steps": run["steps"], "seed": run["seed"]},
        **{"train_s": run["train_s"], "peak_mib": run["peak_vram_mib"], "gpu": run["gpu"]},
        **_common(result),
    }


def _pack_lines(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Lines of the default pack and of the fine-tuned one, as far as they were made."""
    run = result["measured"]
    return [
        {
            **{"run": run["scene"], "variant": run["variant"], "finetune_steps": steps, "bytes": packed["bytes"]},
            **_common(result),
            **{"psnr_packed": packed["psnr"], "ssim_packed": packed["ssim"]},
        }
        for steps, packed in ((0, result["packed"]), (FINETUNE_STEPS, result.get("tuned")))
        if packed
    ]
