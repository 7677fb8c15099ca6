"""How much the head hangs on where its pixels lie: python benchmarks/shifts.py --load-config RUN/config.yml [--views 5].

Each test view is rendered again by cameras whose picture is shifted by whole pixels. A picture that is a function of the scene
alone moves along; what is left after it has been moved back is the head's own. Beside it: PSNR and SSIM of the same pictures,
the head run over several places of its grid, and the correction blurred. The last part says how much resampling alone does: the
mean change of a picture that is moved by half a pixel and back. Edges of 40 pixels are left out. Writes results/shifts.json.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from rich.progress import track
from torch import Tensor

from sundae_ns.compensation import PHASES
from sundae_ns.evaluation import psnr, ssim
from sundae_ns.model import SundaeModel
from sundae_ns.rendering.views import View
from sundae_ns.scenes.opening import load_run

RESULTS = Path(__file__).parent / "results" / "shifts.json"
EDGE = 40
SHIFTS = (1, 2, 4, 8, 16)
BLURS: dict[str, Sequence[float]] = {
    "1 8 1": (0.1, 0.8, 0.1),
    "1 4 1": (1 / 6, 4 / 6, 1 / 6),
    "1 2 1": (0.25, 0.5, 0.25),
}


def inner(picture: Tensor, shift: int = 0) -> Tensor:
    """Without edges, moved back by a shift; of one size for all shifts."""
    width = picture.shape[1] - 2 * EDGE - max(SHIFTS)
    return picture[EDGE:-EDGE, EDGE + shift : EDGE + shift + width]


def blurred(picture: Tensor, taps: Sequence[float]) -> Tensor:
    """``[H, W, 3]`` by three taps in each direction."""
    kernel = torch.tensor(taps, device=picture.device)
    planes = F.pad(picture.permute(2, 0, 1)[:, None], (1, 1, 1, 1), mode="replicate")
    across = F.conv2d(planes, kernel.view(1, 1, 1, 3))
    return F.conv2d(across, kernel.view(1, 1, 3, 1))[:, 0].permute(1, 2, 0)


def half_a_pixel(picture: Tensor, sign: float) -> Tensor:
    """Moved to the right by half a pixel, or to the left, by bilinear sampling."""
    height, width, _ = picture.shape
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5 + sign / 2, indexing="ij")
    grid = torch.stack([2 * x / width - 1, 2 * y / height - 1], dim=-1)[None].to(picture)
    planes = F.grid_sample(picture.permute(2, 0, 1)[None], grid, padding_mode="border", align_corners=False)
    return planes[0].permute(1, 2, 0)


def rendered(model: SundaeModel, view: View, shift: int) -> dict[str, Tensor]:
    K = view.K.clone()
    K[0, 2] += shift
    pictures, _ = model.render(model.gaussians, view._replace(K=K), model._get_background_color(), depth=False)
    return {name: pictures[name] for name in ("rgb", "base_rgb")}


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--load-config", type=Path, required=True)
    parser.add_argument("--views", type=int, default=5, help="test views, evenly chosen")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    run = load_run(options.load_config)
    model, head = run.model, run.model.head
    if head is None:
        raise SystemExit("this run has no head")
    chosen = torch.linspace(0, len(run.cameras) - 1, options.views).round().long().unique().tolist()
    sums: dict[str, dict[str, float]] = {}

    def add(variant: str, what: str, value: float) -> None:
        held = sums.setdefault(variant, {})
        held[what] = held.get(what, 0.0) + value / len(chosen)

    def compare(variant: str, truth: Tensor, by_shift: Callable[[int], Tensor], shifts: Sequence[int]) -> None:
        picture = by_shift(0)
        add(variant, "psnr", float(psnr(inner(picture), inner(truth))))
        add(variant, "ssim", float(ssim(inner(picture), inner(truth))))
        for shift in shifts:
            moved = inner(by_shift(shift), shift) - inner(picture)
            add(variant, f"change, {shift} px", float(moved.abs().mean()))

    for i in track(chosen, description="Views"):
        view, truth = model.view_of(run.cameras[i]), run.truths[i]
        for phases in PHASES:
            head.config.phases = phases  # type: ignore[assignment]
            shown = {shift: rendered(model, view, shift) for shift in (0, *(SHIFTS if phases == 1 else SHIFTS[:2]))}
            compare(
                f"{phases} runs", truth, lambda s, shown=shown: shown[s]["rgb"].clamp(0, 1), [s for s in shown if s]
            )
            if phases > 1:
                continue
            compare("base colours", truth, lambda s, shown=shown: shown[s]["base_rgb"], SHIFTS)
            for name, taps in BLURS.items():

                def smoothed(
                    s: int, shown: dict[int, dict[str, Tensor]] = shown, taps: Sequence[float] = taps
                ) -> Tensor:
                    base = shown[s]["base_rgb"]
                    return (base + blurred(shown[s]["rgb"] - base, taps)).clamp(0, 1)

                compare(f"blurred by {name}", truth, smoothed, SHIFTS[:2])
            for name, picture in (
                ("1 runs", shown[0]["rgb"]),
                ("base colours", shown[0]["base_rgb"]),
                ("truth", truth),
            ):
                resampled = half_a_pixel(half_a_pixel(picture, 1.0), -1.0) - picture
                add(name, "half a pixel and back", float(inner(resampled).abs().mean()))
    sizes = {"views": len(chosen), "width": view.width, "height": view.height, "edge": EDGE}
    options.out.write_text(json.dumps({**sizes, "variants": sums}, indent=2) + "\n")
    for name, held in sums.items():
        print(name, {what: round(value, 5) for what, value in held.items()})


if __name__ == "__main__":
    main()
