"""bench_training.py, whose runs stay under /tmp/stock/CAPTURE or /tmp/ours/CAPTURE-ARM, for bench_formats.py and frames."""
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import bench_training as bench

trainer_of, timed, kept = bench.trainer_of, bench.timed, []


def opened(options, arm, out):
    name = options.capture.name
    trainer = trainer_of(options, arm, f"/tmp/stock/{name}" if arm == "splatfacto" else f"/tmp/ours/{name}-{arm}")
    trainer.config.save_config()
    kept.append(trainer)
    return trainer


def saved(options, arm, out):
    row = timed(options, arm, out)
    type(kept[-1]).save_checkpoint(kept[-1], kept[-1].step)
    return row


bench.trainer_of, bench.timed, bench.__file__ = opened, saved, __file__
if __name__ == "__main__":
    bench.main()
