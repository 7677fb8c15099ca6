"""A whole training of the default with all trials, its curve, its quality and its packed bytes: python whole.py DATA OUT.json SEED [options]"""
import json, os, sys, time
from pathlib import Path
import torch
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from harness.job import parse, without_lpips, _set_random_seed
from harness.plan import parser_of
import sundae_ns.training.trials.curve as curve
import sundae_ns.training.trials.count as count
if os.environ.get("ALL"):  # all six trials
    curve.LOST = 1e9
if os.environ.get("LONG"):  # trials of the head of twice their length
    import sundae_ns.training.trials.head as head_trials
    head_trials.TRIAL_STEPS, head_trials.MOST_TRIAL = 2400, 0.08
if os.environ.get("ANNEAL") == "0":  # the rate of the centres as at the prune, for comparison
    real = count.notify_pruned
    count.notify_pruned = lambda *a, ends_at=None, **k: real(*a, **k)
data, out, seed = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
config = parse([os.environ.get("METHOD", "sundae-auto"), "--data", str(data), "--machine.seed", seed, *sys.argv[4:], *parser_of(data)])
config.output_dir = Path(f"/tmp/whole/{out.stem}"); config.vis = "tensorboard"; config.experiment_name, config.timestamp = "r", "run"
config.steps_per_save = config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 10**9
config.pipeline.model.evaluate_prune = False
found = {"scene": data.name, "seed": seed}
def say(**more):
    found.update(more); out.write_text(json.dumps(found))
settle, begin = count.CountTrials._settle, count.CountTrials._begin
def began(self, run):
    torch.cuda.synchronize(); say(before_trials=time.perf_counter() - T); begin(self, run)
def settled(self, run, n):
    torch.cuda.synchronize(); settle(self, run, n); p = self.progress
    say(full=p.full, chosen=p.chosen, counts=p.counts, sizes=p.sizes, measured=p.measured, after_trials=time.perf_counter() - T)
count.CountTrials._begin, count.CountTrials._settle = began, settled
_set_random_seed(config.machine.seed)
with without_lpips():
    trainer = config.setup(local_rank=0, world_size=1); trainer.setup(); config.save_config()
    save = trainer.save_checkpoint; trainer.save_checkpoint = lambda step: None
    T = time.perf_counter(); trainer.train(); torch.cuda.synchronize(); seconds = time.perf_counter() - T
    save(trainer.step)
    m = trainer.pipeline; m.eval()
    f = trainer.pipeline.get_average_eval_image_metrics(step=trainer.step)
    folder = trainer.base_dir
    head = json.loads((folder / "trials.json").read_text()) if (folder / "trials.json").exists() else None
    if head: [a.pop("views", None) for a in (head.get("arms") or {}).values()]
    say(seconds=seconds, psnr=float(f["psnr"]), ssim=float(f["ssim"]), primitives=int(trainer.pipeline.model.state.field.num_primitives), head=head)
from sundae_ns.scenes.packed import packed_run
say(packed=len(packed_run(folder)[1]))
