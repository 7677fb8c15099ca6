"""Weights of floater_odds by logistic regression, each field judged by those of the others: floater_fit.py FIELD.sog ..."""

import dataclasses
import math
import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from cleaning import KINDS, planted  # noqa: E402

import sundae_ns as sn  # noqa: E402
from sundae_ns.core.covariance import rotation_matrices  # noqa: E402
from sundae_ns.core.gaussians import sh_to_rgb  # noqa: E402
from sundae_ns.graph.neighbors import knn  # noqa: E402


def table(path):
    """Features of what may float [M, 7] and whether it was planted, by other cameras and seeds than in cleaning.py."""
    scene = dataclasses.replace(sn.load(path), head=None)
    cameras, dirty = sn.virtual_cameras(scene, 12, seed=1, size=256), scene
    for seed, kind in enumerate(KINDS):
        dirty = planted(dirty, kind, cameras, seed + 10)
    g = dirty.gaussians
    means, widths, opacities = g["means"].double(), g["scales"].double(), g["opacities"][:, 0].double().sigmoid()
    near = knn(means, 16)
    away = (means - means.median(dim=0).values).norm(dim=1)
    reach = away.median()
    away = (away / reach).clamp_min(0.05).log()
    short, middle, long = (widths - reach.log()).sort(dim=1).values.unbind(dim=1)
    gaps = (near.distances[:, [3, -1]] / reach).clamp_min(1e-9).log() - long[:, None]
    larger = (long[:, None] - long[near.indices]).median(dim=1).values
    colors = sh_to_rgb(g.as_harmonics()["features_dc"]).clamp(0, 1).double()
    around = colors[near.indices]
    usual = around.median(dim=1).values
    unlike = (colors - usual).abs().amax(dim=1).clamp_max(0.4)
    mixed = (around - usual[:, None]).abs().amax(dim=2).median(dim=1).values.clamp_max(0.4)
    ball = 11.5 * unlike + 5 * mixed + 0.9 * larger + 1.3 * long + 2 * (short - long).clamp_min(-4) + 0.4
    ball += 1.2 * gaps[:, 0].clamp(-2, 4) + gaps[:, 1].clamp(-1, 4) - 1.9 * away.clamp_min(0) + 3 * (1 - 5 * opacities).clamp_min(0)
    first = torch.where(long - middle > math.log(10), 14 * unlike + 2 * larger - 7.5, ball)
    first -= 5 * (long + math.log(2)).clamp_min(0)
    rows = (first > 0).nonzero()[:, 0]
    others = near.indices[rows]
    turns = rotation_matrices(g["quats"].double()[others].flatten(0, 1)).view(*others.shape, 3, 3)
    steps = ((means[rows, None] - means[others])[..., None, :] @ turns)[..., 0, :] / widths[others].exp()
    weights = (opacities[others] * (-steps.square().sum(dim=2) / 2).exp())[..., None]
    density, color = weights.sum(dim=1), (weights * colors[others]).sum(dim=1)
    unlike_centre = (color / density.clamp_min(1e-9) - colors[rows]).abs().amax(dim=1)
    columns = [value[rows] for value in (first, long, away, gaps[:, 1].clamp(-1, 4), long - middle)]
    return torch.stack([*columns, (density[:, 0] + 1e-3).log(), unlike_centre], 1), (rows >= len(dirty) - 400).double()


def fit(tables):
    """Weights and bias; planted ones of a field weigh as much as all others of it. Newton's steps, damped."""
    x = torch.cat([x for x, _ in tables])
    y = torch.cat([y for _, y in tables])
    w = torch.cat([torch.where(y > 0, 1 / y.sum(), 1 / (1 - y).sum()) for _, y in tables]) * 1000
    mean, spread = x.mean(dim=0), x.std(dim=0)
    z = torch.cat([(x - mean) / spread, torch.ones_like(y)[:, None]], dim=1)
    b, ridge = torch.zeros(z.shape[1]).double(), 1e-5 * w.sum() * torch.eye(z.shape[1]).double()
    for _ in range(25):
        p = (z @ b).sigmoid()
        hessian = (z * (w * p * (1 - p)).clamp_min(1e-9)[:, None]).T @ z + ridge
        step = torch.linalg.solve(hessian, z.T @ (w * (y - p)) - ridge @ b)
        b += step * min(1, 3 / float(step.abs().max()))
    weights = b[:-1] / spread
    return weights, float(b[-1] - weights @ mean)


with torch.no_grad():
    tables = {path: table(path) for path in sys.argv[1:]}
    for path, (x, y) in tables.items():
        weights, bias = fit([other for name, other in tables.items() if name != path] or [(x, y)])
        odds = x @ weights + bias
        print(path, [(t, int((odds[y > 0] > t).sum()), int((odds[y == 0] > t).sum())) for t in (2, 1, 0, -1, -2, -3, -4)])
    print(fit(list(tables.values())))
