"""Copy a capture with training photos of random exposure: expose.py FROM TO 0.15; test photos (eval_*, or every 8th) stay."""

import shutil
import sys
from pathlib import Path

import numpy as np
from PIL import Image

source, to, spread = Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3])
random = np.random.default_rng(0)
shutil.copytree(source, to)
paths = sorted((to / "images").iterdir())
cut = any(path.name.startswith("eval_") for path in paths)
for i, path in enumerate(paths):
    if not path.name.startswith("eval_") if cut else i % 8:
        gain = np.exp(random.normal(0, spread) + random.normal(0, spread / 3, 3))
        pixels = np.asarray(Image.open(path).convert("RGB")) * gain
        Image.fromarray(pixels.clip(0, 255).round().astype(np.uint8)).save(path, quality=97)
