from dataclasses import replace

from sundae_ns.evaluation import Quality, RunFigures, report_text

FIGURES = RunFigures(
    primitives_before=20_000,
    primitives_after=2_000,
    warm_up=Quality(27.126, 0.91234, 0.1),
    after_prune=Quality(12.3, 0.4),
    base=Quality(25.0, 0.85),
    compensated=Quality(26.0, float("nan")),
    bytes_primitives=472_000,
    bytes_head=123_456,
    ms_frame=12.5,
    ms_splat=10.0,
    ms_head=2.5,
)


def _cells(text, row):
    (line,) = [line for line in text.splitlines() if row in line]
    return [cell.strip() for cell in line.strip("│").split("│")][1:]


def test_each_number_is_in_its_cell():
    text = report_text(FIGURES)
    assert _cells(text, "warm-up") == ["20,000", "27.13", "0.9123", "0.1000"]
    assert _cells(text, "after the prune") == ["2,000", "12.30", "0.4000", "-"]
    assert _cells(text, "base colours") == ["2,000", "25.00", "0.8500", "-"]
    assert _cells(text, "compensated") == ["2,000", "26.00", "-", "-"]
    assert _cells(text, "size, MB") == ["0.47", "0.12", "0.60"]
    assert _cells(text, "time per frame, ms") == ["10.00", "2.50", "12.50"]
    assert "10.0% of the primitives kept" in text


def test_skipped_stages_are_left_out():
    text = report_text(replace(FIGURES, compensated=None, ms_frame=None, ms_splat=None, ms_head=None))
    assert "compensated" not in text
    assert "time" not in text


def test_width_is_kept():
    assert all(len(line) <= 60 for line in report_text(FIGURES, width=60).splitlines())
