"""Where the seconds of a prune go on this GPU."""
import time, torch
t = time.monotonic(); import sundae_ns as sn; print("import", time.monotonic() - t)
t = time.monotonic(); scene = sn.load("/tmp/full/bonsai.sundae", device="cuda"); torch.cuda.synchronize(); print("load", time.monotonic() - t)
from sundae_ns.api import pruning, refit
true = refit.refit
def timed(*a, **k):
    torch.cuda.synchronize(); t = time.monotonic(); r = true(*a, **k); torch.cuda.synchronize(); print("  refit", time.monotonic() - t); return r
pruning.refit = timed
for name in ("contribution", "prune_field"):
    def wrap(f, name):
        def g(*a, **k):
            torch.cuda.synchronize(); t = time.monotonic(); r = f(*a, **k); torch.cuda.synchronize(); print(" ", name, time.monotonic() - t); return r
        return g
    setattr(pruning, name, wrap(getattr(pruning, name), name))
for i in range(3):
    t = time.monotonic(); views = sn.virtual_views(scene); torch.cuda.synchronize(); print("views", time.monotonic() - t)
    t = time.monotonic(); small = sn.prune(scene, keep=0.1, views=views); torch.cuda.synchronize(); print("prune", time.monotonic() - t)
    t = time.monotonic(); sn.save(small, f"/tmp/alone-{i}.sundae"); print("save", time.monotonic() - t)
