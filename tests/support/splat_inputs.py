"""Arguments of the rasterisers by keyword."""

import torch

from sundae_ns.core.camera import Camera
from sundae_ns.rasterize import interface
from sundae_ns.rasterize.types import Inputs


def inputs_of(*, viewmat, K, width, height, **values):
    """Inputs with a camera of these values; opacities and colours are 1 by default."""
    ones = values["means"].new_ones(len(values["means"]), 1)
    return Inputs(camera=Camera(viewmat, K, width, height, 1.0), **{"opacities": ones[:, 0], "colors": ones, **values})


def geometry(means, quats, scales, viewmat, K, width, height):
    """Inputs of a projection."""
    return inputs_of(means=means, quats=quats, scales=scales, viewmat=viewmat, K=K, width=width, height=height)


def rasterize(*, backend, **values):
    return interface.rasterize(inputs_of(**values), backend=backend)


def rasterize_cameras(*, viewmats, Ks, backend, **values):
    inputs = inputs_of(viewmat=torch.eye(4), K=torch.eye(3), **values)
    return interface.rasterize_cameras(inputs, viewmats, Ks, backend=backend)


def blending_weights(*, backend, pixels=None, **values):
    return interface.blending_weights(inputs_of(**values), pixels, backend=backend)


def several_views(n=50, channels=4):
    """Gaussians, and three views of them: colours, transforms and intrinsics as ``rasterize_cameras`` takes them."""
    generator = torch.Generator().manual_seed(0)
    shared = {
        "means": torch.rand(n, 3, generator=generator) - 0.5,
        "quats": torch.randn(n, 4, generator=generator),
        "scales": 0.01 + 0.1 * torch.rand(n, 3, generator=generator),
        "opacities": 0.3 * torch.rand(n, generator=generator),
    }
    viewmats = torch.eye(4).repeat(3, 1, 1)
    viewmats[:, :3, 3] = torch.tensor([[0.0, 0.0, 2.0], [0.3, -0.2, 1.5], [0.0, 0.1, 0.4]])
    Ks = torch.tensor([[30.0, 0, 20.0], [0, 28.0, 15.0], [0, 0, 1]]).repeat(3, 1, 1)
    Ks[1, :2] *= 1.5
    return shared, {"colors": torch.rand(3, n, channels, generator=generator), "viewmats": viewmats, "Ks": Ks}
