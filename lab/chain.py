"""A copy of the package whose pruned field relocates and jitters as 3DGS-MCMC does, until 25,000 steps: chain.py FOLDER"""
import shutil, sys
from pathlib import Path
out = Path(sys.argv[1]); out.mkdir(exist_ok=True); shutil.copytree("/opt/site/sundae_ns" if Path("/opt/site/sundae_ns").exists() else "sundae_ns", out / "sundae_ns")
path = out / "sundae_ns/training/densification.py"; text = path.read_text()
old = """        if state.densifying:
            self.densify(state)
"""
assert text.count(old) == 1
path.write_text(text.replace(old, old + """        elif state.pruned and state.schedule_step < 25000 and run.images_per_step == 1:
            params = state.field.data
            if state.schedule_step % 100 == 0:
                relocate(params, state.optimizers, params["opacities"].detach().sigmoid().flatten() <= 0.005, 0.005)
            with torch.no_grad():
                jitter(params, 5e5 * float(state.optimizers["means"].param_groups[0]["lr"]))
"""))
