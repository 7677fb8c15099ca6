import csv
import json
import math
from dataclasses import replace
from io import StringIO

import pytest

from sundae_ns.core.errors import CheckpointError
from sundae_ns.core.metrics import ViewQuality
from sundae_ns.core.tables import number
from sundae_ns.report.measure import COLUMNS, Configuration, csv_text, markdown
from sundae_ns.train.curve import CountCurve, CurvePoint, read_count_curve


def row_of(run):
    header, row = csv.reader(StringIO(csv_text([run.as_json()])))
    assert tuple(header) == COLUMNS
    return dict(zip(header, row, strict=True))


def test_a_row_pairs_each_time_with_the_quality_of_its_configuration(measured):
    row = row_of(replace(measured(), command='sundae compare "a, b"', seed=None))
    assert (row["ms_frame"], float(row["psnr"])) == ("3.5", pytest.approx(25.5))
    assert (row["ms_splat"], float(row["psnr_base"])) == ("2.0", pytest.approx(25.0))
    assert (float(row["ssim"]), float(row["ssim_base"])) == (pytest.approx(0.85), pytest.approx(0.8))
    assert (row["bytes_primitives"], row["bytes_head"], row["bytes_total"]) == ("2000000", "1000000", "3000000")
    assert (row["scene"], row["keep_ratio"], row["seed"]) == ("bicycle", "0.1", "")
    assert row["command"] == 'sundae compare "a, b"'
    run = measured(head=False)  # full and base are the same
    assert not run.has_head
    row = row_of(run)
    assert (row["psnr"], row["ms_frame"]) == (row["psnr_base"], row["ms_splat"]) == ("25.0", "2.0")


def test_a_mean_needs_all_views():
    views = (ViewQuality(math.inf, 0.5, 0.1), ViewQuality(22.0, 0.7, 0.3), ViewQuality(21.0, math.nan))
    missing = ((2, "psnr_fitted"), (3, "lpips"), (3, "ssim"), (0, "psnr"))
    known = {(2, "lpips"): 0.2, (1, "psnr"): math.inf, (2, "psnr"): 61.0}
    for (count, metric), mean in {**known, **dict.fromkeys(missing)}.items():
        assert Configuration("x", 1.0, 1, views[:count]).mean(metric) == pytest.approx(mean), metric


def test_the_net_is_named_only_if_lpips_was_measured(measured):
    run = replace(measured(head=False), lpips_net="alex")
    assert row_of(run)["lpips_net"] == ""
    views = tuple(replace(view, lpips=0.3) for view in run.full.views)
    row = row_of(replace(run, configurations=(replace(run.full, views=views),)))
    assert (float(row["lpips"]), row["lpips_net"]) == (pytest.approx(0.3), "alex")


def test_json_has_no_nan(measured):
    run = measured(head=False)
    run = replace(run, configurations=(replace(run.full, views=(ViewQuality(math.inf, math.nan),)),))
    read = json.loads(json.dumps(run.as_json(), allow_nan=False))
    assert read["configurations"][0]["views"][0]["ssim"] is None
    assert read["bytes_total"] == 1_000_000


def test_each_configuration_has_a_row_of_the_table(measured):
    run = measured("theirs", head=False)
    views = tuple(replace(view, lpips=0.25) for view in run.full.views)
    run = replace(run, lpips_net="vgg", configurations=(replace(run.full, views=views),))
    text = markdown({"bicycle": [measured("ours"), run]}, ["this and that"])
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    assert rows[0][-1] == "LPIPS (vgg)"
    assert rows[2:] == [
        ["ours", "head on", "4,000", "3.00", "3.50", "25.50", "24.50", "0.8500", "26.00", "-"],
        ["ours", "head off", "4,000", "1.00", "2.00", "25.00", "24.00", "0.8000", "26.00", "-"],
        ["theirs", "no head", "4,000", "1.00", "2.00", "25.00", "24.00", "0.8000", "26.00", "0.2500"],
    ]
    assert "rendered with" not in markdown({"bicycle": [run]}, [])
    assert text.startswith("# bicycle\n")
    assert text.endswith("- Left out: this and that\n")
    assert number(None, 2) == number(float("nan"), 2) == "-"
    assert number(1234.567, 1) == "1,234.6"


def test_names_stay_text_in_markdown(measured):
    hostile = "<script>a|b`c\n# d*[e](f)"
    text = markdown({hostile: [measured(hostile)]}, [hostile])
    assert text.count("&lt;script&gt;a\\|b\\`c # d\\*\\[e\\](f)") == 4
    assert len(text.splitlines()) == len(markdown({"a": [measured()]}, ["a"]).splitlines())


POINT = {"count": 200, "bytes": None, "psnr": 30.0, "ssim": 0.91, "psnr_loss": 0.25, "ssim_loss": 0.0}
POINT |= {"psnr_error": 0.02, "ssim_error": 0.0005}
COUNT = {"chosen": 240, "full": 1000, "reason": "the fewest that are as good", "curve": [POINT]}


def test_the_record_of_trials_is_read_or_refused_in_one_line(tmp_path):
    assert read_count_curve(tmp_path) is None
    path = tmp_path / "trials.json"
    path.write_text(json.dumps({"count": COUNT}))
    assert read_count_curve(tmp_path) == CountCurve(240, 1000, COUNT["reason"], (CurvePoint(**POINT),))
    wrong = ({"chosen": "many"}, {"chosen": 1e999}, {"curve": [{"count": 3}]}, {"curve": [{**POINT, "psnr": "x"}]})
    for content in ("", "[]", "[" * 100_000, *(json.dumps({"count": {**COUNT, **each}}) for each in wrong)):
        path.write_text(content)
        with pytest.raises(CheckpointError, match=r"trials\.json cannot be read .*; remove it, or train again"):
            read_count_curve(tmp_path)
