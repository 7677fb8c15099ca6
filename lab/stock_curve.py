"""bench_training.py, whose run of splatfacto stays under /tmp/stock/CAPTURE, for bench_formats.py."""
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import bench_training as bench

trainer_of, timed, kept = bench.trainer_of, bench.timed, []


def opened(options, arm, out):
    trainer = trainer_of(options, arm, f"/tmp/stock/{options.capture.name}" if arm == "splatfacto" else out)
    if arm == "splatfacto":
        trainer.config.save_config()
    kept.append(trainer)
    return trainer


def saved(options, arm, out):
    row = timed(options, arm, out)
    if arm == "splatfacto":
        type(kept[-1]).save_checkpoint(kept[-1], kept[-1].step)
    return row


bench.trainer_of, bench.timed, bench.__file__ = opened, saved, __file__
if __name__ == "__main__":
    bench.main()
