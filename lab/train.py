"""One arm of an experiment: python lab/train.py NAME CAPTURE OUT JSON. Starts from /tmp/warm/CAPTURE (ckpt of the warm-up)."""
import json, math, sys, time
from functools import partial
import torch, tyro
from torch import nn
import torch.nn.functional as F
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.scripts.train import _set_random_seed

name, capture, out, spec = sys.argv[1], sys.argv[2], sys.argv[3], json.loads(sys.argv[4])
steps = spec.get("steps", 15000)
warm = spec.get("warm", "step-000014999")
args = ["sundae", "--data", f"/tmp/scenes/{capture}", "--max-num-iterations", str(steps), "--machine.seed", str(spec.get("seed", 42)),
        "--output-dir", "/tmp/arms", "--experiment-name", name, "--timestamp", capture, "--vis", "tensorboard", "--viewer.quit-on-train-completion", "True",
        "--pipeline.datamanager.cache-images", "gpu", "--steps-per-save", "10000000", "--steps-per-eval-image", "10000000", "--steps-per-eval-all-images", "10000000",
        "--pipeline.model.warm-start", f"/tmp/warm/{capture}/sundae/run/nerfstudio_models/{warm}.ckpt", "--pipeline.model.evaluate-prune", "False"]
for k, v in spec.get("options", {}).items():
    args += ["--" + k, str(v)]
hold = spec.get("holdout", 8 if capture.endswith("W") else 0)
args += ["--pipeline.datamanager.holdout-every", str(hold)]
args += ["colmap", "--colmap-path", "sparse/0", "--downscale-factor", "1"] + (["--eval-mode", "fraction", "--train-split-fraction", "0.0865"] if "16" in capture else ["--eval-mode", "interval", "--eval-interval", "8"])

from sundae_ns.method_configs.sundae import optimizers
from sundae_ns.training.schedulers import PruneAwareDecayConfig
import sundae_ns.compensation.head as head_module
from sundae_ns.compensation.unet import UNet, SLOPE
from sundae_ns.model import SundaeModel
from sundae_ns.evaluation import psnr, ssim
from sundae_ns.training.losses import chain_losses

def conv(i, o, k=3, d=1):
    c = nn.Conv2d(i, o, k, padding=d * (k // 2), dilation=d)
    nn.init.kaiming_normal_(c.weight, a=SLOPE); nn.init.zeros_(c.bias)
    return c

class Thin(nn.Module):
    pixel_unshuffle = 1
    def __init__(self, i, o, width=32, dilations=(1, 1, 1), k=3, skip=False, drop=0.0, norm=False):
        super().__init__()
        self.convs = nn.ModuleList(conv(i if n == 0 else width, width, k, d) for n, d in enumerate(dilations))
        self.out = nn.Conv2d(width, o, 1); nn.init.zeros_(self.out.weight); nn.init.zeros_(self.out.bias)
        self.skip, self.drop = skip, drop
    def forward(self, x):
        for n, c in enumerate(self.convs):
            y = F.leaky_relu(c(x), SLOPE)
            x = x + y if self.skip and n else y
        if self.drop: x = F.dropout2d(x, self.drop, self.training)
        return self.out(x)

class ThinLow(nn.Module):
    """A U-Net at a quarter of the resolution whose channels go into a thin stack at full resolution."""
    pixel_unshuffle = 1
    def __init__(self, i, o, width=32, dilations=(1, 1), low=16, unet=48, factor=4):
        super().__init__()
        self.factor = factor
        self.low = UNet(i, low, unet, max_width=unet, pixel_unshuffle=1)
        self.thin = Thin(i + low, o, width, dilations)
        self.out = self.thin.out
    def forward(self, x):
        h, w = x.shape[-2:]; f = self.factor
        p = F.pad(x, (0, -w % f, 0, -h % f))
        y = self.low(F.avg_pool2d(p, f))
        y = F.interpolate(y, scale_factor=float(f), mode="bilinear", align_corners=False)[..., :h, :w]
        return self.thin(torch.cat([x, y.to(x.dtype)], 1))

if "net" in spec:
    kind, kw = spec["net"]
    cls = {"thin": Thin, "low": ThinLow}[kind]
    def make(i, o, width, **_):
        return cls(i, o, **kw)
    head_module.UNet = make
    head_module.FusedInference = head_module.FusedTraining = lambda net, residual: None
    args[1:1] = ["--pipeline.model.head.fused", "False"]

config = tyro.cli(AnnotatedBaseConfigUnion, args=args)
config.pipeline.datamanager.data = config.data
config.optimizers = optimizers(steps)
final = spec.get("final")
if final is not None:
    for group, o in config.optimizers.items():
        if group in ("means", "compensation", "camera_opt"): continue
        lr = o["optimizer"].lr
        o["scheduler"] = PruneAwareDecayConfig(lr_final=lr * final, max_steps=steps, lr_restart=lr, hold_until_prune=True, shape=spec.get("shape", "cosine"))
for group, factor in spec.get("rates", {}).items():
    o = config.optimizers[group]; o["optimizer"].lr *= factor
    s = o["scheduler"]
    if s is not None:
        s.lr_final *= factor
        if s.lr_restart is not None: s.lr_restart *= factor
if "head_lr" in spec: config.optimizers["compensation"]["optimizer"].lr = spec["head_lr"]; config.optimizers["compensation"]["scheduler"].lr_restart = spec["head_lr"]
if "weight_decay" in spec: config.optimizers["compensation"]["optimizer"].weight_decay = spec["weight_decay"]
if "means" in spec:
    s = config.optimizers["means"]["scheduler"]; s.lr_restart, s.lr_final, s.shape = spec["means"]

_set_random_seed(config.machine.seed)
config.save_config()
trainer = config.setup(local_rank=0, world_size=1)
trainer.setup()
trainer.save_checkpoint = lambda step: None
model, dm = trainer.pipeline.model, trainer.pipeline.datamanager

# --- per-image exposure
exposure = None
if spec.get("exposure"):
    n = len(dm.train_dataset)
    exposure = nn.Parameter(torch.zeros(n, 3, 4, device=model.device))
    eopt = torch.optim.Adam([exposure], lr=spec["exposure"], eps=1e-15)
    eye = torch.eye(3, 4, device=model.device)
    def expose(image, index):
        a = exposure[index] - exposure.mean(0) + eye
        return image @ a[:, :3].T + a[:, 3]
old_outputs = SundaeModel._training_outputs
def outputs(self, camera):
    o = old_outputs(self, camera); self._cam_idx = (camera.metadata or {}).get("cam_idx"); return o
SundaeModel._training_outputs = outputs
old_loss = SundaeModel.get_loss_dict
def loss_dict(self, outputs, batch, metrics_dict=None):
    if exposure is not None and self.training:
        same = outputs["rgb"] is outputs["base_rgb"]
        outputs = dict(outputs); rgb = expose(outputs["rgb"], self._cam_idx)
        outputs["base_rgb"] = rgb if same else expose(outputs["base_rgb"], self._cam_idx)
        outputs["rgb"] = rgb
    losses = old_loss(self, outputs, batch, metrics_dict)
    if spec.get("l2") and self.training and self.step > spec.get("l2_from", 0):
        target = self._target(batch, outputs)
        losses["l2"] = spec["l2"] * F.mse_loss(outputs["rgb"], target)
    r = spec.get("reg", 0)
    if r:
        losses["reg_o"] = r * self.state.field["opacities"].sigmoid().mean()
        losses["reg_s"] = r * self.state.field["scales"].exp().mean()
    if spec.get("head_l2") and self.state.head_enabled:
        losses["corr"] = spec["head_l2"] * (outputs["rgb"] - outputs["base_rgb"]).square().mean()
    return losses
SundaeModel.get_loss_dict = loss_dict

# --- regrowth after the prune: densify by gradients under a rising cap
grow = spec.get("grow")
if grow:
    from sundae_ns.training.field_state import FieldState
    dens = model.extensions[0]; st = dens.strategy
    st.refine_stop_iter = 15000 + grow["until"]; st.reset_every = 10**9; st.refine_start_iter = 0; st.pause_refine_after_reset = 0
    st.refine_scale2d_stop_iter = 0; st.grow_grad2d = grow.get("threshold", 0.0002); st.prune_opa = grow.get("cull", 0.005); st.refine_every = grow.get("every", 100)
    model.state.densify_until = 0
    from sundae_ns.training import densification as dm_
    def densifying(self):
        return self.pruning.get("num_prunes", 0) > 0 and self.schedule_step < 15000 + grow["until"]
    FieldState.densifying = property(densifying)
    old_after = dens.after_step
    def after(run):
        if run.state.densifying:
            if not hasattr(st, "first"): st.first = run.source.total; st.target = int(round(st.first * grow["to"]))
            t = min(1.0, run.state.step / (grow["until"] * 0.9))
            st.cap = int(st.first + (st.target - st.first) * t)
        old_after(run)
    dens.after_step = after

ema = None
def evaluate(step):
    model.eval()
    res = {"name": name, "capture": capture, "step": step, "n": model.num_points, "t": round(time.time() - started, 1)}
    for label in ("head", "base"):
        if label == "head" and model.head is None: continue
        ps, ss = [], []
        model.compensated = label == "head"
        with torch.no_grad():
            for camera, batch in dm.fixed_indices_eval_dataloader:
                o = model.get_outputs_for_camera(camera.to(model.device))
                img = o["rgb"] if label == "head" else o["base_rgb"]
                target = model.target(batch["image"].to(model.device), o["background"])
                ps.append(float(psnr(img, target))); ss.append(float(ssim(img, target)))
        res[label] = [round(sum(ps) / len(ps), 3), round(sum(ss) / len(ss), 4)]
    model.compensated = True
    with torch.no_grad():
        ps = []
        for i in range(0, len(dm.train_dataset), max(1, len(dm.train_dataset) // 12)):
            camera, batch = dm._view(i)
            o = model.get_outputs_for_camera(camera)
            ps.append(float(psnr(o["rgb"], model.target(batch["image"], o["background"]))))
        res["train"] = round(sum(ps) / len(ps), 3)
        if hold:
            for label in ("head", "base"):
                if label == "head" and model.head is None: continue
                model.compensated = label == "head"
                ps, ss = [], []
                for camera, batch in dm.holdout_views():
                    o = model.get_outputs_for_camera(camera)
                    img = o["rgb"] if label == "head" else o["base_rgb"]
                    target = model.target(batch["image"], o["background"])
                    ps.append(round(float(psnr(img, target)), 3)); ss.append(round(float(ssim(img, target)), 4))
                res["held_" + label] = [round(sum(ps) / len(ps), 3), round(sum(ss) / len(ss), 4), ps, ss]
            model.compensated = True
    model.train()
    print("ARM", json.dumps(res), flush=True)
    with open(f"{out}/{name}-{capture}.jsonl", "a") as f: f.write(json.dumps(res) + "\n")

at = set(spec.get("eval", [steps // 3 - 1, 2 * steps // 3 - 1, steps - 1]))
old_iter = trainer.train_iteration
def iteration(step):
    r = old_iter(step)
    if exposure is not None:
        for g in eopt.param_groups: g["lr"] = spec["exposure"] * 0.5 * (1 + math.cos(math.pi * step / steps)) + 1e-6
        eopt.step(); eopt.zero_grad()
    return r
trainer.train_iteration = iteration
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], lambda step: evaluate(step) if step in at else None))
started = time.time()
if "stop" in spec: config.max_num_iterations = spec["stop"]
trainer.train()
