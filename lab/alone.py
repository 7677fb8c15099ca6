"""Where the seconds of a prune go on this GPU, alone."""
import time, torch
t = time.monotonic(); import sundae_ns as sn; print("import", time.monotonic() - t)
t = time.monotonic(); scene = sn.load("/tmp/full/bonsai.sundae", device="cuda"); torch.cuda.synchronize(); print("load", time.monotonic() - t)
from sundae_ns.api import pruning, refit, virtual
held = sn.virtual_views(scene, 32, seed=10_000, size=256)
def wrap(f, name):
    def g(*a, **k):
        torch.cuda.synchronize(); t = time.monotonic(); r = f(*a, **k); torch.cuda.synchronize(); parts.append(f"{name} {time.monotonic() - t:.2f}"); return r
    return g
for name in ("contribution", "prune_field", "refit"):
    setattr(pruning, name, wrap(getattr(pruning, name), name))
for steps, number, side in ((128, 256, 512), (128, 256, 512), (64, 256, 512), (256, 256, 512), (128, 128, 512), (128, 256, 384), (64, 128, 256)):
    refit.STEPS["cuda"], virtual.VIEWS["cuda"], virtual.SIDES["cuda"], parts = steps, number, side, []
    t = time.monotonic(); views = sn.virtual_views(scene); torch.cuda.synchronize(); looked = time.monotonic() - t
    t = time.monotonic(); small = sn.prune(scene, keep=0.1, views=views); torch.cuda.synchronize(); whole = time.monotonic() - t
    print(steps, number, side, f"views {looked:.2f} prune {whole:.2f}", *parts, f"held out {sn.measure(small, scene, held).psnr:.2f}", flush=True)
t = time.monotonic(); sn.save(small, "/tmp/alone.sundae"); print("save", time.monotonic() - t)
