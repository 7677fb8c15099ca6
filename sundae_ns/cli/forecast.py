"""The time of a training on this machine, from steps on a made-up field; a process of its own measures it.

``sundae run`` waits for its commands for hours, and should not keep what this has imported.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from sundae_ns.errors import SundaeError

PRIMITIVES = {"cpu": 50_000, "cuda": 300_000}
"""Size of the field that is measured, by device."""
_PATIENCE = 300
"""Seconds after which there is no forecast."""
_TIMED = 3
"""Steps that are timed, after one that compiles."""


class Forecast(NamedTuple):
    """What a training takes."""

    step_s: float
    """Seconds of a step."""
    steps: int
    """Steps of the method, unless the user gives another number."""
    device: str
    """``cpu`` or ``cuda``."""


def measured_step(method: str, width: int, height: int) -> Forecast | None:
    """Time the steps of a method at a size of images in pixels; None if that is impossible or takes minutes."""
    words = [sys.executable, "-m", __name__, method, str(width), str(height)]
    try:
        done = subprocess.run(words, capture_output=True, encoding="utf-8", check=True, timeout=_PATIENCE)
        return Forecast(**json.loads(done.stdout.splitlines()[-1]))
    except (OSError, subprocess.SubprocessError, ValueError, TypeError, IndexError):
        return None


def trained_size(photos: Path) -> tuple[int, int] | None:
    """Width and height in pixels of the training images of a capture or of photos; None if they are not known."""
    from sundae_ns.data.capture import check_image, read_json
    from sundae_ns.data.layouts import LONGEST_SIDE, posed_layout
    from sundae_ns.data.lenses import size_of_first_image
    from sundae_ns.data.photos import find_photos
    from sundae_ns.poses.video import is_video, video_size

    try:
        layout = posed_layout(photos)
        if layout is not None:
            width, height = layout.size
            return width // layout.downscale, height // layout.downscale
        if (photos / "transforms.json").is_file():
            found = size_of_first_image(read_json(photos / "transforms.json"), photos)
        elif is_video(photos):
            found = video_size(photos)
        else:
            found = check_image(find_photos(photos)[0].path)
    except SundaeError:
        return None
    if found is None:
        return None
    width, height = found
    while max(width, height) > LONGEST_SIDE:
        width, height = width // 2, height // 2
    return width, height


def measure(method: str, width: int, height: int) -> Forecast:
    """Train a field of random primitives for some steps, at full resolution and before the prune."""
    import time

    import torch
    from nerfstudio.data.scene_box import SceneBox

    from sundae_ns import method_configs
    from sundae_ns.rendering import View
    from sundae_ns.training.step import StepInputs

    config = getattr(method_configs, method.replace("-", "_")).config
    device = torch.device(config.machine.device_type)
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(PRIMITIVES[device.type], 3, generator=generator) - 0.5
    colours = torch.randint(0, 256, points.shape, generator=generator, dtype=torch.uint8)
    box = SceneBox(aabb=torch.tensor([[-1.0] * 3, [1.0] * 3]))
    model = config.pipeline.model.setup(scene_box=box, num_train_data=100, metadata={}, seed_points=(points, colours))
    model.to(device).train()
    view = View.look_at(torch.tensor([0.0, -1.2, 0.0]), torch.zeros(3), width=width, height=height).to(device)
    target = torch.rand(height, width, 3, generator=generator).to(device)
    inputs = StepInputs(view, target, None, torch.zeros(3, device=device))
    values = [value for value in model.gauss_params.values() if value.requires_grad and value.numel()]
    optimizer = torch.optim.Adam(values, lr=0.0)

    def step() -> None:
        loss, _, _ = model.training_step(inputs, model.render_settings(training=True))
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        if device.type == "cuda":
            torch.cuda.synchronize()

    step()
    begun = time.perf_counter()
    for _ in range(_TIMED):
        step()
    return Forecast((time.perf_counter() - begun) / _TIMED, config.max_num_iterations, device.type)


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))._asdict()))
