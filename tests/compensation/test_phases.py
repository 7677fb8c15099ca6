"""The mean over shifts of the head's pixel grid: invariants, and less dependence on the grid."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sundae_ns.compensation import PHASES, CompensationHead, HeadConfig, over_phases
from sundae_ns.errors import ConfigError

Images = tuple[Tensor, Tensor, Tensor]


def head(phases: int = 4, **options: object) -> CompensationHead:
    config = {"size": "tiny", "num_features": 5, "phases": phases, **options}
    made = CompensationHead(HeadConfig(**config))  # type: ignore[arg-type]
    for parameter in made.parameters():
        nn.init.normal_(parameter, std=0.1 if parameter.ndim == 1 else parameter[0].numel() ** -0.5)
    return made


def images(height: int = 64, width: int = 80) -> Images:
    """Smooth images, like those of a scene."""
    noise = torch.randn(1, 9, height // 4, width // 4)
    everything = F.interpolate(noise, size=(height, width), mode="bicubic").sigmoid()[0].permute(1, 2, 0)
    return everything[..., :3], torch.cat([everything[..., :3], everything[..., 3:8]], dim=-1), everything[..., 8:]


@torch.no_grad()
def change(made: CompensationHead, inputs: Images, pixels: int) -> float:
    """Mean change of the image when the camera shifts by some pixels, edges excluded."""
    here = over_phases(made, *inputs)
    there = over_phases(made, *(image[:, pixels:] for image in inputs))
    return float((here[16:-16, pixels + 16 : -16] - there[16:-16, 16:-16]).abs().mean())


@pytest.mark.parametrize("unshuffle", [1, 2, 4])
@pytest.mark.parametrize("mode", ["residual", "features"])
def test_more_phases_depend_less_on_the_grid(mode: str, unshuffle: int) -> None:
    step = max(unshuffle // 2, 1)
    inputs = images()
    made = {phases: head(phases, mode=mode, pixel_unshuffle=unshuffle) for phases in PHASES}
    for other in made.values():
        other.load_state_dict(made[1].state_dict())
    errors = {phases: change(other, inputs, step) for phases, other in made.items()}
    assert errors[4] < 0.9 * errors[2]
    assert errors[4] < 0.8 * errors[1]
    assert errors[2] < errors[1]


@torch.no_grad()
def test_one_phase_is_the_head() -> None:
    made, inputs = head(1), images()
    assert torch.equal(over_phases(made, *inputs), made(*inputs))


@torch.no_grad()
@pytest.mark.parametrize(("mode", "channels"), [("residual", 9), ("features", 5)])
def test_a_pointwise_head_is_the_same_in_all_phases(mode: str, channels: int) -> None:
    made, inputs = head(1, mode=mode, pixel_unshuffle=1), images()
    made.net = nn.Conv2d(channels, 3, 1)  # type: ignore[assignment]
    alone = made(*inputs)
    for phases in PHASES:
        made.config.phases = phases  # type: ignore[assignment]
        torch.testing.assert_close(over_phases(made, *inputs), alone)


@torch.no_grad()
@pytest.mark.parametrize("phases", PHASES)
@pytest.mark.parametrize(("height", "width"), [(1, 1), (17, 30), (1, 40)])
def test_any_size_and_no_correction_where_nothing_was_splatted(phases: int, height: int, width: int) -> None:
    made = head(phases)
    base, splatted, alpha = torch.rand(height, width, 3), torch.rand(height, width, 8), torch.rand(height, width, 1)
    alpha[: height // 2] = 0
    out = over_phases(made, base, splatted, alpha)
    assert out.shape == (height, width, 3)
    assert out.isfinite().all()
    assert torch.equal(out[: height // 2], base[: height // 2])


@torch.no_grad()
@pytest.mark.parametrize(("mode", "in_a_mirror"), [("residual", 2), ("features", 0)])
def test_half_of_four_runs_of_a_residual_head_see_a_mirror(mode: str, in_a_mirror: int) -> None:
    """Only residual heads train on mirrored images."""
    made, (base, splatted, alpha) = head(4, mode=mode), images()
    base[:] = torch.linspace(0, 1, 80)[None, :, None]  # grows to the right
    seen: list[bool] = []
    made.register_forward_pre_hook(lambda _, given: seen.append(bool(given[0][30, 20, 0] > given[0][30, 60, 0])))
    over_phases(made, base, splatted, alpha)
    assert (len(seen), sum(seen)) == (4, in_a_mirror)


def test_other_counts_are_refused() -> None:
    with pytest.raises(ConfigError, match="phases is 3"):
        head(3)
