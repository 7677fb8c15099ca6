"""A whole run, or a finish from a saved warm-up: python lab/full.py NAME CAPTURE OUT JSON

Keys of the JSON beside those of lab/arms.py:
  "options": {option: value}   of ns-train sundae
  "steps": 30000               steps of this command; 15000 with "warm"
  "warm": NAME                 start from the checkpoint that the run NAME of this capture has saved: same field, optimizers and
                               random state. "head": false does without head and features; options may ask for other features
  "save": step                 save everything after this step
  "fit": steps                 fit the schedule to a run of so many steps; "images": folder of smaller images, a divisor
  "eval": [steps]
  "tied": true             the head is equivariant to mirroring (symmetry.py)
  "net": [KIND, OPTIONS]   another network (nets.py)
  "all": true              every trial pays, so that the run gets 29 features
  "flicker": true          measure flicker at the end
  "texture": T             the last 3 T features are slopes inside each primitive (texture.py)
A capture called garden16 (a link to garden) trains on 16 views of garden and tests on 40 others.
"""
import json, os, sys, time
sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import torch, tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.scripts.train import _set_random_seed

name, capture, out, spec = sys.argv[1], sys.argv[2], sys.argv[3], json.loads(sys.argv[4])
place, device = os.environ.get("LAB", "/tmp"), "cuda" if torch.cuda.is_available() else "cpu"
warm = spec.get("warm")
steps = spec.get("steps", 15000 if warm else 30000)
args = ["sundae", "--data", f"{place}/scenes/{capture}", "--max-num-iterations", str(steps), "--machine.seed", str(spec.get("seed", 42)),
        "--output-dir", f"{place}/full", "--experiment-name", name, "--timestamp", capture, "--vis", "tensorboard", "--viewer.quit-on-train-completion", "True",
        "--pipeline.datamanager.cache-images", "gpu", "--steps-per-save", "10000000", "--steps-per-eval-image", "10000000", "--steps-per-eval-all-images", "10000000",
        "--pipeline.model.evaluate-prune", "False"]
options = dict(spec.get("options", {}))
if warm or "save" in spec:  # checkpoints of undecided heads cannot be loaded into others
    options.setdefault("pipeline.model.head.mode", "off" if spec.get("head") is False else "residual")
for k, v in options.items(): args += ["--" + k, str(v)]
args += ["colmap", "--colmap-path", "sparse/0", "--downscale-factor", str(spec.get("images", 1))]
images = len(os.listdir(f"{place}/scenes/{capture}/images"))
args += ["--eval-mode", "fraction", "--train-split-fraction", str(16 / images - 1e-6)] if capture.endswith("16") else ["--eval-mode", "interval", "--eval-interval", "8"]
from sundae_ns.compensation import Window
from sundae_ns.evaluation import psnr, ssim
from sundae_ns.rendering.render import render
from sundae_ns.gaussians import FEATURES, initial_features
from sundae_ns.storage.runs import checkpoint
import arms
if "inputs" in spec:  # letters: d for directions, z for inverse distances
    import inputs
    inputs.install("d" in spec["inputs"], "z" in spec["inputs"])

arms.patch_losses(spec)
if spec.get("all"):  # every trial pays
    from sundae_ns.training import trials
    trials.Progress.best = lambda self: self.tried[-1]
if spec.get("tied"):  # mirror-equivariant weights
    import symmetry
    symmetry.install()
if "net" in spec:  # heads at full resolution
    import nets
    nets.install(*spec["net"])
    args[1:1] = ["--pipeline.model.head.fused", "False"]
if "texture" in spec:
    import texture
    texture.install(spec["texture"], spec.get("through", False))
config = tyro.cli(AnnotatedBaseConfigUnion, args=args)
config.pipeline.datamanager.data = config.data
if "fit" in spec:
    config.schedule_length = spec["fit"]
    config.make_schedule(args)
_set_random_seed(config.machine.seed)
config.save_config()


def load(trainer, path):
    """Restore a warm-up of any kind of head: features and head are those of this run, because none has been trained."""
    loaded, own, prefix = checkpoint.load(path), trainer.pipeline.state_dict(), "_model."
    model = {k: v for k, v in loaded["pipeline"].items() if not k.startswith(prefix + "networks.")}
    model |= {k: v for k, v in own.items() if k.startswith(prefix + "networks.")}
    extra, width = model[prefix + "_extra_state"], trainer.pipeline.model.config.num_features
    extra["num_features"], key = width, prefix + "gauss_params." + FEATURES
    colors = model[prefix + "gauss_params.features_dc"]
    model.pop(key, None)
    if key in own:
        model[key] = initial_features(colors, width) if width else colors.new_zeros(len(colors), 0)
    loaded["pipeline"] = model
    for part in ("optimizers", "schedulers"):
        states = {k: v for k, v in loaded[part].items() if k in getattr(trainer.optimizers, part) and k != "compensation"}
        if part == "optimizers": states.pop(FEATURES, None)
        loaded[part] = states
    trainer._restore(loaded)
    for key, scheduler in trainer.optimizers.schedulers.items():  # the head's is new: it counts steps from the start too
        if key not in loaded["schedulers"]: scheduler.last_epoch = loaded["step"] + 1


trainer = config.setup(local_rank=0, world_size=1)
if warm:
    folder = f"{place}/full/{warm}/sundae/{capture}/nerfstudio_models"
    trainer._load_checkpoint = lambda: load(trainer, checkpoint.checkpoints(__import__("pathlib").Path(folder))[-1])
trainer.setup()
save, trainer.save_checkpoint = trainer.save_checkpoint, lambda step: None
model, dm = trainer.pipeline.model, trainer.pipeline.datamanager
end = trainer._start_step + steps
arm = arms.Arm({"end": end, **spec}, trainer)
path = f"{out}/{name}-{capture}.jsonl"
def note(**figures):
    with open(path, "a") as f: f.write(json.dumps({"name": name, "capture": capture, "t": round(time.time() - started, 1), **figures}) + "\n")
def quality(views, more=False):
    labels = ("head", "base") + (("x0.8", "x0.9", "x1.1", "both") if more else ())
    ps = {label: [] for label in labels}; ss = {label: [] for label in labels}
    with torch.no_grad():
        for camera, batch in views:
            o = model.get_outputs_for_camera(camera.to(model.device)); target = model.target(batch["image"].to(model.device), o["background"])
            shown = {"head": o["rgb"], "base": o["base_rgb"]}
            if more:  # the correction weaker or stronger, and the mean with the mirrored image's
                shown |= {f"x{g}": (o["base_rgb"] + g * (o["rgb"] - o["base_rgb"])).clamp(0, 1) for g in (0.8, 0.9, 1.1)}
                view = model.view_of(camera)
                turned, _ = render(model.source, view.cut(Window(0, 0, view.width, view.height, True)), model.shown_background, model.render_settings(training=False), depth=False)
                shown["both"] = (o["rgb"] + turned["rgb"].flip(1)) / 2
            for label, image in shown.items():
                ps[label].append(float(psnr(image, target))); ss[label].append(float(ssim(image, target)))
    return {label: [round(sum(ps[label]) / len(ps[label]), 3), round(sum(ss[label]) / len(ss[label]), 4)] for label in ps}
def evaluate(step, wide=False, **more):
    model.eval()
    views = list(dm.fixed_indices_eval_dataloader); views = views[::max(1, len(views) // 40)]
    result = quality(views, wide and model.state.head_enabled)
    if step == end - 1:
        shown = dm.train_indices[:: max(1, len(dm.train_indices) // 12)]
        result["train"] = quality([dm._view(i) for i in shown])["head"][0]
        opacities = model.state.field["opacities"].detach().sigmoid()
        result["faint"] = round(float((opacities < 0.05).float().mean()), 4)
    model.train()
    note(step=step, n=model.num_points, head_there=model.state.head_enabled, recorded=trainer._recorded is not None, **result, **more)
at = set(spec.get("eval", [4999, 9999, 14999, 15499, 16499, 17999, 19999, 24999, 29999])) | {end - 1}
AFTER, BEFORE = TrainingCallbackLocation.AFTER_TRAIN_ITERATION, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION
trainer.callbacks.insert(1, TrainingCallback([AFTER], lambda step: evaluate(step) if step in at else None))
trainer.callbacks.append(TrainingCallback([BEFORE], arm.before))
trainer.callbacks.append(TrainingCallback([AFTER], arm.after))
if "save" in spec:
    trainer.callbacks.append(TrainingCallback([AFTER], lambda step: save(step) if step == spec["save"] else None))
started = time.time()
trainer.train()
seconds = round(time.time() - started, 1)
if arm.mean is not None:
    arm.swap(); evaluate(end - 1, average=arm.averaged)
    if not spec.get("keep_average"): arm.swap()
for k, (count, mean) in getattr(arm, "means", {}).items():
    arm.mean = mean
    arm.swap(); evaluate(end - 1, average=count, over=k, wide=True); arm.swap()
if spec.get("flicker") and model.state.head_enabled:
    from types import SimpleNamespace
    from sundae_ns.scenes.flicker import measure_flicker
    model.eval()
    found = measure_flicker(SimpleNamespace(model=model, datamanager=dm, source=name))
    note(flicker=[[f.frames_apart, f.excess, f.excess_base, round(f.ratio, 2)] for f in found])
record = trainer.base_dir / "trials.json"
note(seconds=seconds, spec=spec, trials=json.loads(record.read_text()) if record.exists() else None)
if "save" not in spec:
    trainer.checkpoint_dir.mkdir(parents=True, exist_ok=True)  # without optimizers: for packing alone
    torch.save({"step": end - 1, "pipeline": trainer.pipeline.state_dict(), "optimizers": {}, "schedulers": {}, "scalers": {}}, trainer.checkpoint_dir / f"step-{end - 1:09d}.ckpt")
