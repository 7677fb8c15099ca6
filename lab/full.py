"""A whole run with evaluations on the way: python lab/full.py NAME CAPTURE OUT JSON {"options":{}, "reg": after the prune, "eval": steps}."""
import json, sys, time
import torch, tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.scripts.train import _set_random_seed
name, capture, out, spec = sys.argv[1], sys.argv[2], sys.argv[3], json.loads(sys.argv[4])
steps = spec.get("steps", 30000)
args = ["sundae", "--data", f"/tmp/scenes/{capture}", "--max-num-iterations", str(steps), "--machine.seed", str(spec.get("seed", 42)),
        "--output-dir", "/tmp/full", "--experiment-name", name, "--timestamp", capture, "--vis", "tensorboard", "--viewer.quit-on-train-completion", "True",
        "--pipeline.datamanager.cache-images", "gpu", "--steps-per-save", "10000000", "--steps-per-eval-image", "10000000", "--steps-per-eval-all-images", "10000000",
        "--pipeline.model.evaluate-prune", "False"]
for k, v in spec.get("options", {}).items(): args += ["--" + k, str(v)]
args += ["colmap", "--colmap-path", "sparse/0", "--downscale-factor", "1"] + (["--eval-mode", "fraction", "--train-split-fraction", "0.0865"] if "16" in capture else ["--eval-mode", "interval", "--eval-interval", "8"])
from sundae_ns.model import SundaeModel
from sundae_ns.evaluation import psnr, ssim
config = tyro.cli(AnnotatedBaseConfigUnion, args=args)
config.pipeline.datamanager.data = config.data
_set_random_seed(config.machine.seed)
config.save_config()
trainer = config.setup(local_rank=0, world_size=1); trainer.setup(); trainer.save_checkpoint = lambda step: None
model, dm = trainer.pipeline.model, trainer.pipeline.datamanager
old_loss = SundaeModel.get_loss_dict
def loss_dict(self, outputs, batch, metrics_dict=None):
    losses = old_loss(self, outputs, batch, metrics_dict)
    r = spec.get("reg", 0)
    if r and self.state.pruning["num_prunes"]:
        losses["reg_o"] = r * self.state.field["opacities"].sigmoid().mean(); losses["reg_s"] = r * self.state.field["scales"].exp().mean()
    return losses
SundaeModel.get_loss_dict = loss_dict
def evaluate(step):
    model.eval()
    res = {"name": name, "capture": capture, "step": step, "n": model.num_points, "t": round(time.time() - started, 1), "head_there": model.head is not None}
    views = list(dm.fixed_indices_eval_dataloader); views = views[::max(1, len(views) // 40)]
    ps = {"head": [], "base": []}; ss = {"head": [], "base": []}
    with torch.no_grad():
        for camera, batch in views:
            o = model.get_outputs_for_camera(camera.to(model.device)); target = model.target(batch["image"].to(model.device), o["background"])
            for label, key in (("head", "rgb"), ("base", "base_rgb")):
                ps[label].append(float(psnr(o[key], target))); ss[label].append(float(ssim(o[key], target)))
    for label in ps: res[label] = [round(sum(ps[label]) / len(ps[label]), 3), round(sum(ss[label]) / len(ss[label]), 4)]
    model.train()
    with open(f"{out}/{name}-{capture}.jsonl", "a") as f: f.write(json.dumps(res) + "\n")
at = set(spec.get("eval", [4999, 9999, 14999, 15499, 16499, 17999, 19999, 24999, 29999]))
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
trainer.callbacks.insert(1, TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], lambda step: evaluate(step) if step in at else None))
started = time.time()
trainer.train()
record = trainer.base_dir / "trials.json"
with open(f"{out}/{name}-{capture}.jsonl", "a") as f:
    f.write(json.dumps({"name": name, "capture": capture, "t": round(time.time() - started, 1), "trials": json.loads(record.read_text()) if record.exists() else None}) + "\n")
trainer.checkpoint_dir.mkdir(parents=True, exist_ok=True)  # without optimizers: for packing alone
torch.save({"step": steps - 1, "pipeline": trainer.pipeline.state_dict(), "optimizers": {}, "schedulers": {}, "scalers": {}}, trainer.checkpoint_dir / f"step-{steps - 1:09d}.ckpt")
