"""Render a packed scene with its head, without it, and the difference of both, side by side.

python examples/render_packed.py scene.sundae image.png --camera 0
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from PIL import Image

import sundae_ns as sn


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="file of sundae pack")
    parser.add_argument("out", type=Path, help="image to write")
    parser.add_argument("--camera", type=int, default=0, help="index of a camera stored with the scene")
    options = parser.parse_args()

    scene = sn.load(options.scene, device="cuda" if torch.cuda.is_available() else "cpu")
    camera = scene.cameras[options.camera] if scene.cameras else sn.virtual_cameras(scene, 1, size=512)[0]
    rendering = sn.render(scene, camera)
    change = (rendering.rgb - rendering.base_rgb).abs() * 5
    row = torch.cat([rendering.rgb, rendering.base_rgb, change.clamp(0, 1)], dim=1)
    Image.fromarray((row * 255).round().byte().cpu().numpy()).save(options.out)
    print(f"{scene}: image, base colours, and five times their difference, in {options.out}")


if __name__ == "__main__":
    main()
