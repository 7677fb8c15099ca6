"""A field that is right, photos of it by cameras on a ring, and the measurement of their gains."""

import math
from functools import cache
from types import SimpleNamespace

import torch

from sundae_ns.core.camera import Camera
from sundae_ns.train.exposure import FIRST_STEPS, REFRESHED_EVERY, ExposureCompensation

COUNT = 48
ANGLES = torch.arange(COUNT) * 2 * math.pi / COUNT


def ring(count=COUNT):
    """Cameras on a circle that look at its middle."""
    angles = torch.arange(count) * 2 * math.pi / count
    return [Camera.look_at((3 * math.cos(a), 3 * math.sin(a), 1.0), (0, 0, 0), width=64, height=48) for a in angles]


def run_of(cameras, device="cpu"):
    indices = list(range(len(cameras)))
    shown = [(camera, None) for camera in cameras]
    members = {"view_indices": lambda: indices, "training_views": lambda: shown, "images_per_step": 1}
    return SimpleNamespace(state=SimpleNamespace(step=0, device=torch.device(device)), **members)


def begin(mode="on", device="cpu"):
    gains, run = ExposureCompensation(COUNT, mode), run_of(ring(), device)
    gains.before_training(run)
    return gains, run


@cache
def image_of(index):
    """What the field shows of a view, dark enough that no photo is clipped."""
    return 0.1 + 0.4 * torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(index))


def batch_of(index, channels=3):
    return {"image_idx": index, "image": torch.zeros(48, 64, channels, dtype=torch.uint8)}


def measure(gains, run, photos, rounds=12, *, late=True):
    """Steps that see each photo once between two updates. The field is right, and does not change.

    Late ones are at the step from which ``auto`` decides.
    """
    for _ in range(rounds):
        run.state.step = 0
        for index in range(COUNT):
            batch = batch_of(index)
            gains.observe(image_of(index), gains.balanced(photos(index), batch), None, batch)
        update(gains, run, late=late)


def update(gains, run, *, late=True):
    run.state.step = -(-(FIRST_STEPS if late else 1) // REFRESHED_EVERY) * REFRESHED_EVERY - 1
    gains.after_step(run)
    run.state.step = 0
