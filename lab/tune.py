"""Fine-tune a finished run in several ways, and measure each pack: python lab/tune.py RUN OUT.jsonl NAME ..."""
import json, sys, time
from dataclasses import replace
from pathlib import Path
import torch
import sundae_ns.scenes.finetune as tuning
from sundae_ns.scenes.opening import open_scene
from sundae_ns.scenes.packed import contents_of_run
from sundae_ns.storage.packing import FINETUNED, PackConfig, write_fitted
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from harness.job import _written  # noqa: E402

RATES = dict(tuning.RATES)
def coarser(share, names=None):
    return {k: (v * share if isinstance(v, float) and (names is None or k in names) else v) for k, v in FINETUNED.items()}
WAYS = {  # name: steps, rate, factor of Adam's rates, options of the pack
    "now": (1500, 0.025, 1.0, FINETUNED),
    "again": (1500, 0.025, 1.0, FINETUNED),
    "long": (4000, 0.025, 1.0, FINETUNED),
    "fast": (1500, 0.025, 2.5, FINETUNED),
    "slow": (1500, 0.025, 0.4, FINETUNED),
    "cheap": (1500, 0.0125, 1.0, FINETUNED),
    "dear": (1500, 0.05, 1.0, FINETUNED),
    "fine": (1500, 0.025, 1.0, coarser(0.7)),
    "fine-dear": (1500, 0.05, 1.0, coarser(0.7)),
    "coarse": (1500, 0.025, 1.0, coarser(1.4)),
    "coarse-cheap": (1500, 0.0125, 1.0, coarser(1.4)),
    "positions": (1500, 0.025, 1.0, {**FINETUNED, "position_bits": 13}),
    "head": (1500, 0.025, 1.0, coarser(2.0, {"head_step"})),
    "features": (1500, 0.025, 1.0, coarser(1.6, {"feature_step"})),
}
run, out = Path(sys.argv[1]), Path(sys.argv[2])
opened = open_scene(run)
for name in sys.argv[3:]:
    steps, rate, factor, options = WAYS[name]
    tuning.RATES = {k: v * factor for k, v in RATES.items()}
    began = time.time()
    scene, codecs = tuning.finetune(opened.source, contents_of_run(opened.source), PackConfig(**options), steps, rate=rate)
    took = time.time() - began
    path = out.with_suffix(f".{name}.sundae")
    found = _written(opened, path, scene, codecs)
    path.unlink()
    with out.open("a") as file:
        file.write(json.dumps({"run": run.parent.name, "way": name, "seconds": round(took, 1), **found}) + "\n")
    torch.cuda.empty_cache()
