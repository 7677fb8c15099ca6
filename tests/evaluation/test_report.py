from sundae_ns.evaluation import report_text

STAGES = (
    ("warm-up", 20_000, {"psnr": 27.126, "ssim": 0.91234, "lpips": 0.1, "other": 7.0}),
    ("after the prune", 2_000, {"psnr": 12.3, "ssim": 0.4}),
    ("final, base colours", 2_000, {"psnr": 25.0, "ssim": 0.85}),
    ("final, compensated", 2_000, {"psnr": 26.0, "ssim": float("nan")}),
)
SIZES, TIMES = (472_000, 123_456), (10.0, 2.5, 12.5)


def _cells(text, row):
    (line,) = [line for line in text.splitlines() if row in line]
    return [cell.strip() for cell in line.strip("│").split("│")][1:]


def test_each_number_is_in_its_cell():
    text = report_text("A run", STAGES, SIZES, TIMES)
    assert _cells(text, "warm-up") == ["20,000", "27.13", "0.9123", "0.1000"]
    assert _cells(text, "after the prune") == ["2,000", "12.30", "0.4000", "-"]
    assert _cells(text, "base colours") == ["2,000", "25.00", "0.8500", "-"]
    assert _cells(text, "compensated") == ["2,000", "26.00", "-", "-"]
    assert _cells(text, "size, MB") == ["0.47", "0.12", "0.60"]
    assert _cells(text, "time per frame, ms") == ["10.00", "2.50", "12.50"]
    assert "10.0% of the primitives kept" in text


def test_skipped_stages_are_left_out():
    stages = (*STAGES[:1], ("after the prune", 2_000, None), *STAGES[2:])
    assert "after the prune" not in report_text("A run", stages, SIZES, TIMES)


def test_width_is_kept():
    assert all(len(line) <= 100 for line in report_text("A run " * 30, STAGES, SIZES, TIMES).splitlines())
