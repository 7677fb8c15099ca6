"""Held-out and test figures after each window of a run of few views that never rests: rest_curves.py CAPTURE OUT [--seed K WORD ...]"""

import json
import sys
from pathlib import Path

from few_job import few_job  # its import finds the harness

import harness.job as job_module
from sundae_ns.train import choice, trials

capture, out, *words = sys.argv[1:]
job = few_job(capture, f"rest-{Path(capture).name}", "rest", "sundae", 30000, words)
made, rows = {}, []
trainer_of, measure = job_module.trainer_of, trials.Trials.measure


def keep_trainer(config, *ranks):
    made["trainer"], save = trainer_of(config, *ranks)
    return made["trainer"], save


def measure_both(self, run):
    stage = self.progress.stage
    found = measure(self, run)
    if stage == "length":
        pipeline = made["trainer"].pipeline
        with self._mean.shown(trials.weights_of(run.state)):
            held = trials.measure_held_out(run, with_fitted=True)
            test = pipeline.get_average_eval_image_metrics()
        rows.append({"step": run.state.schedule_step, "held": [list(view) for view in held], "test": {k: float(v) for k, v in test.items()}})
    return found


job_module.trainer_of = keep_trainer
trials.Trials.measure = measure_both
trials.WATCHED_SHARE = 1.0
choice.best_length = lambda *given: (1, False)
folder = Path(out) / job.key
config, command = job_module.configure(job, folder)
_, measured = job_module._measured(job, config, command)
plain = measured.as_json()
record = json.loads(next(folder.glob("jobs/*/*/*/run/trials.json")).read_text())
final = plain["configurations"][0]["mean"]
Path(out, f"{job.key}.json").write_text(json.dumps({"capture": job.scene, "seed": job.seed, "count": plain["primitives"], "rows": rows, "final": final, "trials": record}) + "\n")
