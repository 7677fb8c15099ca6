"""Which operations of a training step launch which kernels: ops.py CAPTURE FEATURES KEEP."""
import sys
from pathlib import Path
from tempfile import mkdtemp

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import torch
from harness.job import configure, trainer_of
from harness.plan import Job, parser_of
from sundae_ns.train.graphed_step import RecordedStep

data, features, keep = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
words = ("--pipeline.model.pruning.keep-ratio", keep, "--pipeline.model.evaluate-prune", "False", "--pipeline.datamanager.cache-images", "gpu", "--viewer.quit-on-train-completion", "True")
words += ("--pipeline.model.head.mode", "residual", "--pipeline.model.head.num-features", features) if features != "0" else ("--pipeline.model.head.mode", "off")
words += ("--pipeline.model.pruning.prune-at", "12000", "--schedule-length", "30000")
job = Job("ops", "whole", data.name, "ops", str(data), "sundae", 12200, 42, options=words, parser=tuple(parser_of(data)))
trainer = trainer_of(configure(job, Path(mkdtemp()))[0])[0]
trainer.train()
print("trained", trainer.model.num_points, flush=True)
trainer._recorded = RecordedStep(trainer.model.losses, record=False)
step = 12201
for _ in range(5):
    trainer.train_iteration(step); step += 1
from torch.profiler import ProfilerActivity, profile
N = 20
with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA], record_shapes=True) as prof:
    for _ in range(N):
        trainer.train_iteration(step); step += 1
    torch.cuda.synchronize()
rows = [(e.self_device_time_total / N, e.count / N, e.key, str(e.input_shapes)) for e in prof.key_averages(group_by_input_shape=True) if e.self_device_time_total > 0]
for us, count, key, shapes in sorted(rows, reverse=True)[:110]:
    print(f"{us:8.1f} {count:6.1f} {key[:70]:70} {shapes[:150]}")
