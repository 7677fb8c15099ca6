"""ns-train with parts of a chain in densification: python lab/hybrid.py prior,noise -- ns-train's words"""
import sys
from sundae_ns.gaussians.relocation import jitter
from sundae_ns.training import densification, losses
ways = sys.argv[1].split(",")
sys.argv = ["ns-train", *sys.argv[3:]]
usual = losses.StepLosses.prior_weight
weight = {"prior": 0.01, "light": 0.003}
for name, value in weight.items():
    if name in ways:
        losses.StepLosses.prior_weight = lambda self, state, value=value: value if state.densifying else usual(self, state)
if "noise" in ways:
    densify = densification.Densification.densify
    def noisy(self, state):
        densify(self, state)
        jitter(state.field.data, 5e5 * state.optimizers["means"].param_groups[0]["lr"])
    densification.Densification.densify = noisy
from nerfstudio.scripts.train import entrypoint
entrypoint()
