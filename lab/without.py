"""bench_training.py without one trick of the head: TRICK=mirror or decay."""
import os, sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import bench_training as bench
from sundae_ns.training import step

if os.environ["TRICK"] == "mirror":
    whole = step.training_window
    step.training_window = lambda *words, mirror=False, **more: whole(*words, mirror=False, **more)
else:
    assert os.environ["TRICK"] == "decay"
    trainer_of = bench.trainer_of

    def undecayed(options, arm, out):
        options.option = [*options.option, "--optimizers.compensation.optimizer.weight-decay", "0"]
        return trainer_of(options, arm, out)

    bench.trainer_of = undecayed
bench.__file__ = __file__
if __name__ == "__main__":
    bench.main()
