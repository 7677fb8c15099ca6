from dataclasses import replace
from multiprocessing.pool import ThreadPool

import pytest

from sundae_ns.errors import DataError
from sundae_ns.evaluation import COLUMNS, RunRow, append_row, csv_text, read_rows

HEADER = (
    "scene,method,variant,keep_ratio,seed,steps,primitives,psnr,ssim,psnr_base,ssim_base,lpips,lpips_net,"
    "bytes_primitives,bytes_head,bytes_total,ms_frame,ms_splat,ms_head,train_s,prune_s,peak_primitives,"
    "peak_vram_mib,gpu,resolution,commit,command"
)
ROW = RunRow(
    scene="bonsai",
    method="sundae",
    variant='band, "literal" tau',
    keep_ratio=0.1,
    seed=3,
    steps=30_000,
    primitives=125_000,
    psnr=31.0 + 1 / 3,
    ssim=0.94,
    psnr_base=30.5,
    ssim_base=0.93,
    lpips=None,
    lpips_net="alex",
    bytes_primitives=36_000_000,
    bytes_head=7_800_000,
    bytes_total=43_800_000,
    ms_frame=3.5,
    ms_splat=2.0,
    ms_head=1.5,
    train_s=600.0,
    prune_s=1.25,
    peak_primitives=1_300_000,
    peak_vram_mib=2345.5,
    gpu="NVIDIA H100",
    resolution="1237x822",
    commit="abc1234",
    command="ns-train sundae --data x",
)


def test_header_is_exact(tmp_path):
    append_row(tmp_path / "new" / "runs.csv", ROW)
    lines = (tmp_path / "new" / "runs.csv").read_text().splitlines()
    assert lines[0] == HEADER == ",".join(COLUMNS)
    assert len(lines) == 2


def test_round_trip(tmp_path):
    path = tmp_path / "runs.csv"
    rows = [ROW, replace(ROW, keep_ratio=None, ssim=float("nan"), seed=4), replace(ROW, psnr=float("inf"))]
    for row in rows:
        append_row(path, row)
    back = read_rows(path)
    assert back == [rows[0], replace(rows[1], ssim=None), rows[2]]


def test_csv_text_is_the_content_of_the_file(tmp_path):
    rows = [ROW, replace(ROW, ssim=float("nan"), command="a \n b")]
    for row in rows:
        append_row(tmp_path / "runs.csv", row)
    assert (tmp_path / "runs.csv").read_text() == csv_text(rows)
    assert csv_text([]).splitlines() == [HEADER]


def test_a_row_is_one_line(tmp_path):
    path = tmp_path / "runs.csv"
    append_row(path, replace(ROW, command="ns-train \\\n  sundae\r\n --data x"))
    assert len(path.read_text().splitlines()) == 2
    assert read_rows(path)[0].command == "ns-train \\ sundae --data x"


def test_a_missing_final_newline_is_added(tmp_path):
    path = tmp_path / "runs.csv"
    append_row(path, ROW)
    path.write_text(path.read_text().rstrip("\n"))
    append_row(path, replace(ROW, seed=9))
    assert [row.seed for row in read_rows(path)] == [3, 9]


def test_empty_file_gets_its_header(tmp_path):
    path = tmp_path / "runs.csv"
    path.touch()
    append_row(path, ROW)
    assert read_rows(path) == [ROW]


def test_concurrent_appends_lose_nothing(tmp_path):
    path = tmp_path / "runs.csv"
    append_row(path, ROW)
    with ThreadPool(8) as pool:
        pool.map(lambda seed: append_row(path, replace(ROW, seed=seed)), range(100))
    assert sorted(row.seed for row in read_rows(path)[1:]) == list(range(100))


@pytest.mark.parametrize(
    "header", [HEADER.replace("psnr_base,", ""), HEADER + ",extra", HEADER.replace("scene,method", "method,scene")]
)
def test_other_columns_are_refused_untouched(tmp_path, header):
    path = tmp_path / "runs.csv"
    path.write_text(header + "\n")
    with pytest.raises(DataError, match="other columns"):
        append_row(path, ROW)
    assert path.read_text() == header + "\n"
    with pytest.raises(DataError, match="other columns"):
        read_rows(path)


def test_unusable_files(tmp_path):
    with pytest.raises(DataError, match="cannot be read"):
        read_rows(tmp_path / "gone.csv")
    with pytest.raises(DataError, match="cannot be written"):
        append_row(tmp_path, ROW)
    path = tmp_path / "runs.csv"
    append_row(path, ROW)
    path.write_text(path.read_text() + "bonsai,sundae\n")
    with pytest.raises(DataError, match="row 3"):
        read_rows(path)
