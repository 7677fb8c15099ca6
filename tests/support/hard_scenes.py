"""Scenes that are hard to render, before activation and in float32 numbers, so that both precisions render the same."""

import math

import torch

NEAR = 2.0**-6  # A float32 number, so that a Gaussian can lie on the plane in both precisions


def scene(n=300, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return {
        "means": (torch.rand(n, 3, generator=generator) - 0.5) * 2 + torch.tensor([0.0, 0.0, 3.0]),
        "quats": torch.randn(n, 4, generator=generator),
        "scales": torch.log(0.02 + 0.1 * torch.rand(n, 3, generator=generator)),
        "opacities": torch.randn(n, generator=generator),
        "colors": torch.rand(n, 3, generator=generator),
    }


def with_values(rows, **values):
    """The scene with other values in some rows."""
    made = scene()
    for name, value in values.items():
        made[name][rows] = torch.tensor(value)
    return made


HALF, ALL, NEEDLE = slice(150), slice(None), [math.log(1e3), *2 * [math.log(1e-8)]]


def around_the_near_plane():
    """Gaussians on the plane, one step of float32 before and behind it, on the camera, and behind it."""
    made = scene()
    near = torch.tensor(NEAR)
    steps = [near, near.nextafter(torch.tensor(1.0)), near.nextafter(torch.tensor(0.0)), 0 * near, -near, -near * 100]
    for i, z in enumerate(steps):
        made["means"][10 * i : 10 * i + 10, 2] = z
        made["means"][10 * i : 10 * i + 5, :2] = 0.0
    return made


def on_one_pixel(logit=None):
    made = scene(5_000)
    made["means"][:, :2] *= 1e-3
    made["scales"] -= 1.0
    return made if logit is None else {**made, "opacities": torch.full((5_000,), logit)}


def huge_at_the_near_plane():
    made = scene(40)
    made["means"][:, 2] = torch.linspace(-0.02, 0.03, 40)
    made["scales"][::2] = math.log(1e3)
    return made


# Scene, image size, and the bounds on the errors of the image and of the worst gradient. Measured worst cases: 9.9e-7
# and 9.3e-6, except where noted.
CASES = {
    "ordinary": (scene, 48, 5e-6, 2e-5),
    "scales of 1e-8": (lambda: with_values(HALF, scales=math.log(1e-8)), 48, 5e-6, 2e-5),
    "scales of 1e3": (lambda: with_values(HALF, scales=math.log(1e3)), 48, 5e-6, 2e-5),
    "needles of 1e3 and 1e-8": (lambda: with_values(HALF, scales=NEEDLE), 48, 5e-5, 1e-3),  # measured 6.5e-6, 1.6e-4
    "logits of 30": (lambda: with_values(HALF, opacities=30.0), 48, 5e-6, 2e-5),
    "logits of -30": (lambda: with_values(HALF, opacities=-30.0), 48, 5e-6, 2e-5),
    "on and behind the near plane": (around_the_near_plane, 48, 5e-6, 2e-5),
    "all behind the camera": (lambda: with_values(ALL, means=-10.0), 48, 0.0, 0.0),
    "all at the camera": (lambda: with_values(ALL, means=0.0), 48, 0.0, 0.0),
    "all beside the image": (lambda: with_values(ALL, means=1e6), 48, 0.0, 0.0),
    "transparent": (lambda: with_values(ALL, opacities=-200.0), 48, 0.0, 0.0),
    "vanishing": (lambda: with_values(ALL, scales=-70.0), 20, 5e-6, 1e-4),  # squares underflow
    "huge at the near plane": (huge_at_the_near_plane, 20, 5e-5, 1e-3),
    "none": (lambda: scene(0), 20, 0.0, 0.0),
    "quaternions of zeros": (lambda: with_values(HALF, quats=0.0), 48, 5e-6, 2e-5),
    "an image of one pixel": (scene, 1, 5e-6, 1e-4),  # measured 9.9e-7 and 2.0e-5
    "5,000 on one pixel": (on_one_pixel, 16, 5e-6, 2e-5),
    "5,000 opaque on one pixel": (lambda: on_one_pixel(30.0), 16, 5e-6, 2e-5),
}
