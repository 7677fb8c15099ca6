from __future__ import annotations

from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

from sundae_ns.evaluation.curves import read_curves


def record(folder: Path, steps: range, value: float, **more: float) -> None:
    writer = SummaryWriter(log_dir=str(folder))
    for step in steps:
        writer.add_scalar("Train Loss", value / (step + 1), step)
        for tag, constant in more.items():
            writer.add_scalar(f"Train Metrics Dict/{tag}", constant, step)
    writer.close()


def test_all_points_of_all_curves(tmp_path: Path) -> None:
    record(tmp_path, range(0, 30_000, 10), 4.0, psnr=20.0, psnr_base=19.0, gaussian_count=300)
    curves = read_curves(tmp_path)
    assert curves is not None
    assert len(curves.loss.steps) == 3000  # tensorboard's default keeps a sample of 1,000
    assert curves.loss.steps[-1] == 29_990
    assert curves.loss.values[0] == 4
    assert set(curves.psnr.values) == {20.0}
    assert set(curves.psnr_base.values) == {19.0}
    assert set(curves.primitives.values) == {300.0}
    assert not curves.memory.steps


def test_the_later_record_of_a_resumed_run_counts(tmp_path: Path) -> None:
    record(tmp_path, range(10), 1.0)
    (first,) = tmp_path.iterdir()
    # tensorboard distinguishes files by the second of their start; a resumed run starts later.
    first.rename(tmp_path / "events.out.tfevents.0000000001.here.1.0")
    record(tmp_path, range(5, 15), 2.0)
    curves = read_curves(tmp_path)
    assert curves is not None
    assert curves.loss.steps == tuple(range(15))
    assert abs(curves.loss.values[4] - 1 / 5) < 1e-6
    assert abs(curves.loss.values[5] - 2 / 6) < 1e-6


def test_missing_and_damaged_files(tmp_path: Path) -> None:
    assert read_curves(tmp_path) is None
    assert read_curves(tmp_path / "nowhere") is None
    (tmp_path / "events.out.tfevents.1.here.1.0").write_bytes(b"not an event file at all, by any means")
    assert read_curves(tmp_path) is None
