"""ns-train with parts of a chain in densification, or with photos' own light: python lab/hybrid.py WAYS -- ns-train's words

WAYS by commas: prior, light-prior (0.01 and 0.003 from the start); late (0.01 from step 2,900); probe (what an affine fit
gains at held-out views at some steps); affineNN, centredNN, gainNN, each
-pruned (the loss compares after NN% of the affine fit of colours; less the mean fit; by gains and offsets);
denseNN (points of a sweep through NN views); shading (what the loss compares darkens away from the middle, by three
numbers for each channel of the whole capture; lab/shaded.py measures with them)."""
import re
import sys
import torch
from sundae_ns.training import densification, losses
from sundae_ns.training.heldout import measure_heldout

ways = sys.argv[1].split(",")
sys.argv = ["ns-train", *sys.argv[3:]]
LATE, PROBES = 2900, (300, 600, 1000, 1500, 2000, 2900, 4000, 6000, 8000, 10000)
usual = losses.StepLosses.prior_weight
weight = next((w for n, w in (("prior", 0.01), ("late", 0.01), ("light-prior", 0.003)) if n in ways), 0.0)
since = LATE if "late" in ways else 0
if weight:
    losses.StepLosses.prior_weight = lambda self, state: (weight if state.schedule_step > since else 0.0) if state.densifying else usual(self, state)
if "probe" in ways:
    after = densification.Densification.after_step
    def probe(self, run):
        after(self, run)
        if run.state.schedule_step in PROBES and run.num_heldout and run.state.densifying:
            views = measure_heldout(run, with_fitted=True)
            gaps = sorted(v.fitted - v.psnr for v in views)
            print(f"PROBE {run.state.schedule_step} {gaps[len(gaps) // 2]:.3f} " + " ".join(f"{g:.2f}" for g in gaps), flush=True)
    densification.Densification.after_step = probe
kind = next((m for m in (re.fullmatch(r"(affine|centred|gain)(\d+)(-pruned)?", w) for w in ways) if m), None)
if kind:
    plain, share, mean = losses.StepLosses.__call__, int(kind[2]) / 100, {}
    def fitted(self, state, params, rgb, base, target, mask, count=None):
        if kind[3] and not state.pruned:
            return plain(self, state, params, rgb, base, target, mask, count)
        with torch.no_grad():
            r, t = (x.detach().reshape(-1, 3)[::3] for x in (rgb, target))
            if kind[1] == "gain":
                d = r - r.mean(0)
                slope = (d * (t - r)).mean(0) / (d.square().mean(0) + 1e-3)
                moved = torch.cat([torch.diag(slope), ((t - r).mean(0) - slope * r.mean(0))[None]])
            else:
                rows = torch.cat([r, torch.ones_like(r[:, :1])], 1).double()
                normal = rows.T @ rows / len(rows) + 1e-4 * torch.eye(4, dtype=rows.dtype, device=rows.device)
                moved = torch.linalg.solve_ex(normal, rows.T @ (t - r).double() / len(rows))[0].float()
            if kind[1] != "affine":  # without what all images have in common
                mean.setdefault("of", torch.zeros_like(moved)).lerp_(moved, 0.02)
                moved = moved - mean["of"]
            moved = share * moved
        def apply(x):
            return x + x @ moved[:3] + moved[3]
        same = base is rgb
        rgb = apply(rgb)
        return plain(self, state, params, rgb, rgb if same else apply(base), target, mask, count)
    losses.StepLosses.__call__ = fitted
if "nomirror" in ways:
    from sundae_ns import model
    resolution = model.SundaeModel.resolution
    model.SundaeModel.resolution = lambda self, step: resolution(self, step)._replace(mirror=False)
if "nodecay" in ways:
    from sundae_ns import callbacks
    start, act = callbacks.NerfstudioRun.start, callbacks.NerfstudioRun.act
    def without(self):
        for group in self.state.optimizers["compensation"].param_groups:
            group["weight_decay"] = 0.0
    callbacks.NerfstudioRun.start = lambda self: (start(self), without(self))[0]
    callbacks.NerfstudioRun.act = lambda self, extensions: (act(self, extensions), without(self))[0]
most = next((int(w[5:]) for w in ways if re.fullmatch(r"dense\d+", w)), 0)
if most:  # with --pipeline.model.dense-start-views 1000: a sweep through a spread of the views
    from sundae_ns.training import dense_start
    sweep = dense_start.Sweep
    dense_start.Sweep = lambda photos, sparse, longest: sweep(photos[:: -(-len(photos) // most)], sparse, longest)
if "shading" in ways:
    import atexit
    from pathlib import Path
    unshaded, shading = losses.StepLosses.__call__, {}
    class Shade(torch.autograd.Function):  # Adam's step is part of the backward pass, so that it can be recorded
        @staticmethod
        def forward(ctx, x):
            if not shading:
                shading.update({k: torch.zeros(3, 3, device=x.device) for k in ("a", "m", "v")})
            h, w = x.shape[:2]
            y, x_ = ((torch.arange(n, device=x.device) + 0.5 - n / 2) / (w / 2) for n in (h, w))
            r = (y[:, None] ** 2 + x_[None] ** 2)[..., None]
            powers = torch.stack([r, r * r, r**3])
            ctx.save_for_backward(x, powers)
            return x * (1 + (powers * shading["a"][:, None, None]).sum(0))
        @staticmethod
        def backward(ctx, g):
            x, powers = ctx.saved_tensors
            gain, a, m, v = 1 + (powers * shading["a"][:, None, None]).sum(0), *(shading[k] for k in "amv")
            grad = (powers * (g * x)).sum((1, 2))
            m.lerp_(grad, 0.1), v.lerp_(grad * grad, 0.01)
            a.sub_(0.002 * m / (v.sqrt() + 1e-12))
            return g * gain
    def shaded(self, state, params, rgb, base, target, mask, count=None):
        same, rgb = base is rgb, Shade.apply(rgb)
        return unshaded(self, state, params, rgb, rgb if same else Shade.apply(base), target, mask, count)
    losses.StepLosses.__call__ = shaded
    words = {k: sys.argv[sys.argv.index(k) + 1] for k in ("--output-dir", "--experiment-name")}
    where = Path(words["--output-dir"]) / words["--experiment-name"] / "shading.pt"
    atexit.register(lambda: torch.save(shading["a"].cpu(), where))
from sundae_ns.training import dense_start as _dense
import time
_swept = _dense.DenseStart._swept
def timed(self, run, sparse):
    began = time.time()
    found = _swept(self, run, sparse)
    torch.cuda.synchronize() if torch.cuda.is_available() else None
    print(f"SWEEP {sys.argv[sys.argv.index('--data') + 1]} {ways} {time.time() - began:.1f} s {len(found[0])} points beside {len(sparse)}", flush=True)
    return found
_dense.DenseStart._swept = timed
from nerfstudio.scripts.train import entrypoint
entrypoint()
