"""Median milliseconds of the demo's training steps by phase: python lab/demo_steps.py .demo/scene OUT [SEED [UNSHUFFLE]]

Run it as `sundae` runs ns-train: OMP_WAIT_POLICY=PASSIVE, and the MALLOC_ variables of sundae_ns/cli/main.py.
"""
import statistics, sys, time
from copy import deepcopy
from pathlib import Path
import torch
from nerfstudio.scripts.train import _set_random_seed
from sundae_ns.method_configs import sundae_tiny


def main():
    scene, out, seed, fold = Path(sys.argv[1]), Path(sys.argv[2]), *map(int, (sys.argv[3:] + ["42", "1"][len(sys.argv) - 3:])[:2])
    config = deepcopy(sundae_tiny.config)
    config.pipeline.datamanager.data, config.output_dir, config.experiment_name, config.timestamp = scene, out, "demo", "now"
    config.pipeline.model.background_color, config.pipeline.model.head.pixel_unshuffle = "white", fold
    config.machine.seed, config.machine.device_type = seed, "cpu"
    sys.argv = ["x"]
    config.make_schedule([])
    _set_random_seed(seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    marks, iterate = [], trainer.train_iteration
    trainer.train_iteration = lambda step: (marks.append(time.perf_counter()), iterate(step))[1]
    trainer.train()
    steps = [1e3 * (b - a) for a, b in zip(marks, marks[1:])]
    for begin, end in ((20, 200), (200, 400), (400, 599), (610, 900), (900, 1198)):
        print(begin, end, f"median {statistics.median(steps[begin:end]):.1f} ms, best decile {sorted(steps[begin:end])[(end - begin) // 10]:.1f}")
    found = trainer.pipeline.get_average_eval_image_metrics(step=1199)
    print({name: round(float(found[name]), 4) for name in ("psnr", "ssim", "psnr_base", "ssim_base")}, torch.get_num_threads(), "threads")


if __name__ == "__main__":
    main()
