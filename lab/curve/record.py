"""Train the warm-up of a capture, then trials of many counts, measured at several lengths: python record.py DATA OUT.json [SEED]"""
import json, sys, time
from pathlib import Path
import torch
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from harness.job import parse, without_lpips, _set_random_seed
from harness.plan import parser_of
import sundae_ns.training.trials.count as count
from sundae_ns.training.heldout import view_quality
from sundae_ns.rendering.render import render_view

count.SHARES = (1.0, 0.4, 0.2, 0.1, 0.05, 0.025)
count.TRIAL_SHARE, count.WINDOWS = 0.05, 5
data, out, seed = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3] if len(sys.argv) > 3 else "42"
TIMES = []

def fitted(image, target):
    """PSNR after the best affine colour map."""
    x = torch.cat([image.reshape(-1, 3), torch.ones_like(image.reshape(-1, 3)[:, :1])], 1).double()
    y = target.reshape(-1, 3).double()
    best = torch.linalg.lstsq(x, y).solution
    return float(-10 * torch.log10(((x @ best - y) ** 2).mean()))

class Stop(Exception):
    pass

@torch.no_grad()
def measure(self, run):
    from sundae_ns.training.trials.engine import weights_of, RunningMean
    e = self._engine; found = []
    with e._mean.shown(weights_of(run.state)):
        for view, target, mask in run.heldout_views():
            images, _ = render_view(run.source, view, run.background, run.settings, depth=False)
            q = view_quality(images["rgb"], target, mask)
            found.append([q.pixels, q.psnr, q.ssim, fitted(images["rgb"], target)])
    e._mean = RunningMean()
    torch.cuda.synchronize() if torch.cuda.is_available() else None
    TIMES.append(time.perf_counter())
    return found

def decide(self, run):
    p = self.progress
    out.write_text(json.dumps({"scene": data.name, "seed": seed, "full": p.full, "shares": count.SHARES, "measured": p.measured, "times": TIMES, "began": BEGAN, "started": STARTED,
        "held": self._plan(run).views, "views": len(run.view_indices()), "steps": p.steps, "window": self._window}))
    raise Stop

count.CountTrials._measure = measure
count.CountTrials._decide = decide
begin = count.CountTrials._begin
BEGAN = STARTED = None
def begun(self, run):
    global BEGAN
    torch.cuda.synchronize() if torch.cuda.is_available() else None
    BEGAN = time.perf_counter()
    # the unpruned field, as it is
    TIMES.append(BEGAN)
    begin(self, run)
count.CountTrials._begin = begun
args = [sys.argv[4] if len(sys.argv) > 4 else "sundae", "--data", str(data), "--machine.seed", seed, *sys.argv[5:], *parser_of(data)]
config = parse(args)
config.output_dir = Path(f"/tmp/record/{data.name}-{seed}"); config.vis = "tensorboard"; config.experiment_name, config.timestamp = "r", "run"
config.steps_per_save = config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 10**9
_set_random_seed(config.machine.seed)
with without_lpips():
    trainer = config.setup(local_rank=0, world_size=1); trainer.setup(); trainer.save_checkpoint = lambda step: None
    STARTED = time.perf_counter()
    try:
        trainer.train()
    except Stop:
        print("recorded", out)
