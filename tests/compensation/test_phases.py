"""The mean over places of the head's grid of pixels: what it leaves alone, and that it hangs less on them."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sundae_ns.compensation import PHASES, CompensationHead, HeadConfig, over_phases
from sundae_ns.errors import ConfigError

Pictures = tuple[Tensor, Tensor, Tensor]


def head(phases: int = 4, **options: object) -> CompensationHead:
    made = CompensationHead(HeadConfig(**{"size": "tiny", "num_features": 5, "phases": phases, **options}))  # type: ignore[arg-type]
    for parameter in made.parameters():
        nn.init.normal_(parameter, std=0.1 if parameter.ndim == 1 else parameter[0].numel() ** -0.5)
    return made


def pictures(height: int = 64, width: int = 80) -> Pictures:
    """Smooth ones, as those of a scene are."""
    noise = torch.randn(1, 9, height // 4, width // 4)
    everything = F.interpolate(noise, size=(height, width), mode="bicubic").sigmoid()[0].permute(1, 2, 0)
    return everything[..., :3], torch.cat([everything[..., :3], everything[..., 3:8]], dim=-1), everything[..., 8:]


@torch.no_grad()
def moves(made: CompensationHead, seen: Pictures, pixels: int) -> float:
    """Mean change of a picture that is seen from one pixel beside, edges left out."""
    here = over_phases(made, *seen)
    there = over_phases(made, *(picture[:, pixels:] for picture in seen))
    return float((here[16:-16, pixels + 16 : -16] - there[16:-16, 16:-16]).abs().mean())


@pytest.mark.parametrize("unshuffle", [1, 2, 4])
@pytest.mark.parametrize("mode", ["residual", "features"])
def test_more_phases_hang_less_on_the_grid(mode: str, unshuffle: int) -> None:
    step = max(unshuffle // 2, 1)
    seen = pictures()
    made = {phases: head(phases, mode=mode, pixel_unshuffle=unshuffle) for phases in PHASES}
    for other in made.values():
        other.load_state_dict(made[1].state_dict())
    errors = {phases: moves(other, seen, step) for phases, other in made.items()}
    assert errors[4] < 0.9 * errors[2]
    assert errors[4] < 0.8 * errors[1]
    assert errors[2] < errors[1]


@torch.no_grad()
def test_one_phase_is_the_head() -> None:
    made, seen = head(1), pictures()
    assert torch.equal(over_phases(made, *seen), made(*seen))


@torch.no_grad()
def test_a_head_that_knows_no_neighbours_is_the_same_in_all_phases() -> None:
    made, seen = head(1, mode="features", pixel_unshuffle=1), pictures()
    made.net = nn.Conv2d(5, 3, 1)  # type: ignore[assignment]
    alone = made(*seen)
    for phases in PHASES:
        made.config.phases = phases  # type: ignore[assignment]
        torch.testing.assert_close(over_phases(made, *seen), alone)


@torch.no_grad()
@pytest.mark.parametrize("phases", PHASES)
@pytest.mark.parametrize(("height", "width"), [(1, 1), (17, 30), (1, 40)])
def test_any_size_and_nothing_where_nothing_was_splatted(phases: int, height: int, width: int) -> None:
    made = head(phases)
    base, splatted, alpha = torch.rand(height, width, 3), torch.rand(height, width, 8), torch.rand(height, width, 1)
    alpha[: height // 2] = 0
    out = over_phases(made, base, splatted, alpha)
    assert out.shape == (height, width, 3)
    assert out.isfinite().all()
    assert torch.equal(out[: height // 2], base[: height // 2])


def test_other_counts_are_refused() -> None:
    with pytest.raises(ConfigError, match="phases is 3"):
        head(3)
