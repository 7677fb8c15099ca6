"""``sundae curve``: what it prints and plots of a run's record, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from sundae_ns.cli import main

POINT = {"bytes": 250_000, "psnr": 30.0, "ssim": 0.91, "psnr_error": 0.02, "ssim_error": 0.0005}
RECORD = {
    "chosen": 240,
    "full": 1000,
    "reason": "the fewest that are as good as the best",
    "curve": [
        {**POINT, "count": 1000, "psnr_loss": 0.0, "ssim_loss": 0.001, "measured": []},
        {**POINT, "count": 200, "psnr_loss": 0.25, "ssim_loss": 0.0, "bytes": None},
        {**POINT, "count": 100, "psnr_loss": None, "ssim_loss": None, "psnr": None, "ssim": None},
    ],
}


def code_of(words: list[str]) -> int:
    with pytest.raises(SystemExit) as caught:
        main(words)
    return int(caught.value.code or 0)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "curve.json").write_text(json.dumps(RECORD))
    return folder


@pytest.mark.parametrize("given", ["", "config.yml"])
def test_the_table_has_each_count_and_the_choice(run: Path, capsys: pytest.CaptureFixture[str], given: str) -> None:
    (run / "config.yml").write_text("{}")
    assert code_of(["curve", str(run / given)]) == 0
    *_, full, fifth, broken, chosen = capsys.readouterr().out.splitlines()
    assert full == "| 1,000 | 0.25 | 30.00 | 0.00 ± 0.02 | 0.9100 | 0.0010 ± 0.0005 |"
    assert fifth.startswith("| 200 |  | 30.00 | 0.25 ± 0.02 |")
    assert broken == "| 100 | 0.25 |  | not finite |  | not finite |"
    assert chosen == "chosen: 240 of 1,000, the fewest that are as good as the best"


def test_json_has_the_same_numbers(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(["curve", str(run), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["chosen"], found["full"], len(found["points"])) == (240, 1000, 3)
    assert found["points"][1] == {key: value for key, value in RECORD["curve"][1].items() if key != "measured"}  # type: ignore[index]


def test_the_plot_is_a_picture_and_replaces_nothing(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = run / "curve.png"
    assert code_of(["curve", str(run), "-o", str(out)]) == 0
    with Image.open(out) as image:
        assert min(image.size) > 300
        assert len(image.convert("RGB").getcolors(1 << 24) or []) > 20
    assert code_of(["curve", str(run), "-o", str(out)]) == 2
    assert "curve.png" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "options", "cause"),
    [
        (None, [], "no trials of counts; train it with ns-train sundae"),
        ("", [], "curve.json cannot be read"),
        (json.dumps({**RECORD, "chosen": "many"}), [], "curve.json cannot be read"),
        (json.dumps({**RECORD, "curve": [{"count": 3}]}), [], "curve.json cannot be read"),
        (json.dumps({**RECORD, "curve": [{**RECORD["curve"][0], "psnr": "high"}]}), [], "curve.json cannot be read"),  # type: ignore[index]
        (json.dumps(RECORD), ["-o", "curve.pdf"], "does not end in .png"),
        (json.dumps(RECORD), ["-o", "curve.json"], "does not end in .png"),
    ],
)
def test_refusals_are_one_line(
    run: Path, capsys: pytest.CaptureFixture[str], content: str | None, options: list[str], cause: str
) -> None:
    (run / "curve.json").unlink()
    if content is not None:
        (run / "curve.json").write_text(content)
    assert code_of(["curve", str(run), *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert cause in line
