"""Where a recorded training spends its time: host, wall and GPU of 100 steps in both phases, and the kernels of 20."""
import argparse, pathlib, sys, time
sys.path.insert(0, "benchmarks")
import torch, bench_training as b
arm, steps = sys.argv[1], int(sys.argv[2])
o = argparse.Namespace(capture=pathlib.Path("/tmp/scenes/" + sys.argv[3]), steps=steps, seed=42, curve=[], option=[])
t = b.trainer_of(o, arm, "/tmp/phases")
spans = {int(steps * 0.42): "growing", steps - 300: "late"}
inner = [0.0, 0]
old = t.train_iteration
def timed(step):
    a = time.perf_counter(); r = old(step); inner[0] += time.perf_counter() - a; inner[1] += 1; return r
t.train_iteration = timed
began = prof = None
marks = []
def look(step):
    global began, prof
    if step % 1000 == 999: marks.append(round(time.perf_counter() - t0, 2))
    for s, n in spans.items():
        if step == s:
            torch.cuda.synchronize(); began = time.perf_counter(); inner[:] = [0.0, 0]
        if step == s + 90:
            host = time.perf_counter() - began; torch.cuda.synchronize(); wall = time.perf_counter() - began
            print("PHASE", n, "n", t.pipeline.model.num_points, "host %.2f inner %.2f wall %.2f ms" % (host / 0.09, inner[0] / 0.09, wall / 0.09), flush=True)
            prof = torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]); prof.__enter__()
        if step == s + 115:
            torch.cuda.synchronize(); prof.__exit__(None, None, None)
            table = prof.key_averages().table(sort_by="cuda_time_total", row_limit=70, max_name_column_width=90)
            print("KERNELS of 25 steps", n); print("\n".join(line[:92] + line[-60:] for line in table.splitlines()), flush=True)
alone = {s + 130: n for s, n in spans.items()}
hosts = []
def host(step):
    """Host time of steps while the GPU's queue is short."""
    for s, n in alone.items():
        if step == s: torch.cuda.synchronize(); hosts[:] = [time.perf_counter()]
        elif s < step <= s + 20: hosts.append(time.perf_counter())
        if step == s + 20:
            gaps = sorted(b - a for a, b in zip(hosts, hosts[1:]))
            print("HOST", n, "median %.3f mean %.3f ms" % (1e3 * gaps[len(gaps) // 2], 1e3 * sum(gaps) / len(gaps)), flush=True)
spent = {}
def watch(owner, name):
    old = getattr(owner, name)
    def run(*a, **k):
        c = time.perf_counter(); r = old(*a, **k); e = spent.setdefault(f"{owner.__name__}.{name}", [0, 0.0]); e[0] += 1; e[1] += time.perf_counter() - c; return r
    setattr(owner, name, run)
from sundae_ns.training import recorded as rec, densification as den
from sundae_ns.gpu.nvrtc import Kernel
for owner, name in ((rec.RecordedStep, "_hold"), (rec.RecordedStep, "_run"), (rec.RecordedStep, "_recorded"), (Kernel, "__init__"), (torch.cuda, "empty_cache")): watch(owner, name)
for e in t.pipeline.model.extensions:
    watch(type(e), "after_step")
def report(step):
    if step in (0, 10, 500, 1000, 2000, 3000, 5000, 7500) or step == steps - 1:
        torch.cuda.synchronize(); print("SPENT", step, round(time.perf_counter() - t0, 2), {k: (n, round(s, 2)) for k, (n, s) in spent.items()}, flush=True)
b.after_step(t, look)
b.after_step(t, report)
b.after_step(t, host)
t0 = time.perf_counter()
t.train()
torch.cuda.synchronize()
print("TOTAL", arm, round(time.perf_counter() - t0, 2), "marks", marks, "recordings", None if t._recorded is None else len(t._recorded._recordings))
