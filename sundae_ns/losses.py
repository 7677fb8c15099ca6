"""Terms of the loss."""

from __future__ import annotations

from collections.abc import Mapping

from pytorch_msssim import SSIM
from torch import Tensor

SSIM_WINDOW = 11
MCMC_REGULARISER = 0.01
"""Weights of opacities and sizes in the loss while the field grows by MCMC (lambda_o and lambda_Sigma of the paper)."""


def picture_loss(picture: Tensor, target: Tensor, ssim: SSIM, weight: float) -> Tensor:
    """``lambda_1 L1 + lambda_2 (1 - SSIM)`` of the paper, both pictures ``[H, W, 3]``.

    Args:
        picture, target: what was drawn, and what it should be.
        ssim: of pictures ``[1, 3, H, W]``.
        weight: lambda_2; lambda_1 is the rest. Pictures smaller than SSIM's window are compared by L1 alone.
    """
    l1 = (picture - target).abs().mean()
    if weight == 0 or min(target.shape[:2]) < SSIM_WINDOW:
        return l1
    ssim.win = ssim.win.to(target.device)  # once: it would be copied there, and waited for, each time
    # Contiguous planes: on the interleaved colours of a large picture the same convolutions take much longer.
    planes = (image.permute(2, 0, 1)[None].contiguous() for image in (target, picture))
    return (1 - weight) * l1 + weight * (1 - ssim(*planes))


def chain_losses(params: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What nothing needs becomes transparent and small, and can be moved (equation 10 of 3DGS-MCMC)."""
    return {
        "opacity_loss": MCMC_REGULARISER * params["opacities"].sigmoid().mean(),
        "scale_loss": MCMC_REGULARISER * params["scales"].exp().mean(),
    }
