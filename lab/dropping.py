"""ns-train with up to a share of the primitives left out of a step, rising to the end. dropping.py SHARE -- sundae ..."""
import sys

share = float(sys.argv[1])
sys.argv = ["ns-train", *sys.argv[3:]]
import torch

from sundae_ns.rendering.source import LocalField

length, primitives = 30_000, LocalField.primitives
if "--max-num-iterations" in sys.argv:
    length = int(sys.argv[sys.argv.index("--max-num-iterations") + 1])


def fewer(self, *args, at=None, **words):
    found = primitives(self, *args, at=at, **words)
    if share and at is not None and torch.is_grad_enabled():
        dropped = share * at.step / length
        alpha = found["opacities"].sigmoid() / (1 - dropped)
        stays = torch.rand_like(alpha) >= dropped
        found["opacities"] = torch.logit((alpha * stays).clamp(1e-6, 0.999))
    return found


LocalField.primitives = fewer
from nerfstudio.scripts.train import entrypoint

entrypoint()
