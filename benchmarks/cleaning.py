"""Planted floaters of four kinds: how many ``remove_floaters`` finds, and what else it removes.

    python benchmarks/cleaning.py FIELDS... --captures FOLDER -o benchmarks/results/cleaning.csv

Floaters are planted in the images of cameras found in the clean field; cleaning knows none. What the real Gaussians
that go take along: ``psnr_lost``, in test photos, at most 8, of the capture of the field's name; ``images_lost``, of a
field that shows these cameras 30 dB, by the mean squared error, also of floaters that training left in the field.
"""

import argparse
import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

import sundae_ns as sn
from harness.rows import Rows
from sundae_ns.report.measure import against_photos
from sundae_ns.scene.compose import floater_mask
from sundae_ns.scene.virtual_cameras import middle_and_reach, usable

PLANTED, HELD_OUT, PHOTOS = 100, 12, 8  # floaters of each kind, cameras, and most photos
KINDS, STRENGTHS = ("near", "shell", "haze", "spikes"), (0.25, 0.5)
COLUMNS = ("field", "strength", "kind", "planted", "removed", "others_removed", "psnr_lost", "images_lost")


def points_in_front(
    scene: sn.Scene, cameras: Sequence[sn.Camera], generator: torch.Generator, low: float, high: float
) -> tuple[Tensor, Tensor]:
    """Random points between cameras and what they see ``[PLANTED, 3]``, at shares of the depth, and their depths."""
    points, zs, depths = [], [], [sn.render(scene, camera).depth[..., 0] for camera in cameras]
    for i in range(PLANTED):
        (viewmat, K, *_), depth = cameras[i % len(cameras)], depths[i % len(cameras)]
        row, column = (int(torch.randint(n, (1,), generator=generator)) for n in depth.shape)
        z = float(depth[row, column]) * (low + (high - low) * float(torch.rand(1, generator=generator)))
        ray = torch.stack([(column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1], torch.ones(())])
        points.append(viewmat[:3, :3].T @ (z * ray - viewmat[:3, 3]))
        zs.append(z)
    return torch.stack(points).float(), torch.tensor(zs)[:, None]


def planted(scene: sn.Scene, kind: str, cameras: Sequence[sn.Camera], seed: int) -> sn.Scene:
    """The scene with ``PLANTED`` more Gaussians, the last ones."""
    generator = torch.Generator().manual_seed(seed)

    def random(low: float, high: float, columns: int = 1) -> Tensor:
        return low + (high - low) * torch.rand(PLANTED, columns, generator=generator)

    gaussians = usable(scene)
    middle, reach = middle_and_reach(gaussians)
    distances = (gaussians["means"].double() - middle).norm(dim=1)
    outer = float(distances.sort().values[int(0.99 * len(distances))])
    chosen = torch.randint(len(distances), (PLANTED,), generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(PLANTED, 3, generator=generator), dim=1)
    if kind == "near":
        (means, depths), opacities = points_in_front(scene, cameras, generator, 0.1, 0.4), random(0.3, 0.99)
        scales = depths * random(0.01, 0.1) * random(0.5, 1.5, 3)
    elif kind == "shell":
        means, opacities = middle.float() + directions * outer * random(1, 3), random(0.3, 0.99)
        scales = outer * 0.02 * random(0.5, 1.5, 3)
    elif kind == "haze":
        (means, depths), opacities = points_in_front(scene, cameras, generator, 0.3, 0.7), random(0.03, 0.13)
        scales = depths * random(0.1, 0.3) * random(0.5, 1.5, 3)
    else:
        means, opacities = gaussians["means"][chosen], random(0.5, 0.99)
        scales = reach * torch.cat([random(0.2, 0.4), random(0.002, 0.006, 2)], dim=1)
    quats = torch.nn.functional.normalize(torch.randn(PLANTED, 4, generator=generator), dim=1)
    colors = 3.5 * random(-0.5, 0.5, 3)[:, None]
    floaters = sn.Scene.from_arrays(means, scales, quats, opacities[:, 0], colors).gaussians
    return sn.merge([dataclasses.replace(scene, gaussians=each) for each in (gaussians, floaters)])


def rows_of(path: Path, capture: Path) -> Iterator[tuple[object, ...]]:
    """For each strength a row a kind, and one for all planted at once, whose mask gives what is lost."""
    scene, shown = sn.load(path), against_photos(capture)(path)
    posed = dataclasses.replace(scene, gaussians=shown.source.gaussians, cameras=(), in_model_frame=True)
    some = slice(None, None, -(-len(shown.truths) // PHOTOS))
    whole = sn.measure(posed, shown.truths[some], shown.cameras[some]).psnr
    dirty, cameras = scene, sn.virtual_cameras(scene, HELD_OUT, seed=7, size=256)
    for seed, kind in enumerate(KINDS):
        dirty = planted(dirty, kind, cameras, seed)
    for strength in STRENGTHS:
        n = len(floats := floater_mask(dirty, (), strength)) - PLANTED * len(KINDS)
        psnr = sn.measure(posed[~floats[:n]], shown.truths[some], shown.cameras[some]).psnr
        error = fmean(10 ** (-psnr / 10) for psnr in sn.measure(scene[~floats[:n]], scene, cameras).psnrs)
        lost = f"{whole - psnr:.3f}", f"{10 * math.log10(1 + error / 1e-3):.3f}"
        for kind, part in zip(KINDS, floats[n:].split(PLANTED), strict=True):
            yield path.stem, strength, kind, PLANTED, int(part.sum()), "", "", ""
        yield path.stem, strength, "all", PLANTED * len(KINDS), int(floats[n:].sum()), int(floats[:n].sum()), *lost


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fields", nargs="+", type=Path)
    parser.add_argument("--captures", type=Path, required=True)
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args()
    rows = Rows(options.out, COLUMNS, COLUMNS[:3])
    for path in options.fields:
        for row in rows_of(path, options.captures / path.stem):
            rows.put(dict(zip(COLUMNS, row, strict=True)))


if __name__ == "__main__":
    main()
