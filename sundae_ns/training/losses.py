"""Terms of the loss."""

from __future__ import annotations

import functools
import logging
from collections.abc import Mapping

import torch
from pytorch_msssim import SSIM
from torch import Tensor

from sundae_ns.errors import BackendError
from sundae_ns.gpu.fused_loss import WINDOW, compiled, fused_loss

MCMC_REGULARISER = 0.01
"""Weights of opacities and sizes in the loss while the field grows by MCMC (lambda_o and lambda_Sigma of the paper)."""


_log = logging.getLogger(__name__)


def picture_loss(picture: Tensor, target: Tensor, ssim: SSIM, weight: float) -> Tensor:
    """``lambda_1 L1 + lambda_2 (1 - SSIM)`` of the paper, both pictures ``[H, W, 3]``.

    Args:
        picture, target: what was drawn, and what it should be; a gradient reaches the first.
        ssim: of pictures ``[1, 3, H, W]``, with the window and constants of :mod:`sundae_ns.gpu.fused_loss`, which computes the
            same in one kernel for float32 on CUDA.
        weight: lambda_2; lambda_1 is the rest. Pictures smaller than SSIM's window are compared by L1 alone.
    """
    return picture_losses(picture, None, target, ssim, weight)[0]


def picture_losses(
    picture: Tensor, base: Tensor | None, target: Tensor, ssim: SSIM, weight: float
) -> tuple[Tensor, Tensor | None]:
    """The loss of a picture, see :func:`picture_loss`, and beside it L1 of its base colours.

    Args:
        picture, target, ssim, weight: as there.
        base: base colours ``[H, W, 3]``, which a gradient reaches; None for none.

    Returns:
        Both losses, the second None without base colours.
    """
    single = all(one.dtype == torch.float32 for one in (picture, target, base) if one is not None)
    large = min(target.shape[:2]) >= WINDOW
    if weight > 0 and large and single and picture.is_cuda and _fuses(picture.device):
        return fused_loss(picture, target, weight, base)
    of_base = None if base is None else (base - target).abs().mean()
    if weight == 0 or not large:
        return (picture - target).abs().mean(), of_base
    return convolved_loss(picture, target, ssim, weight), of_base


def convolved_loss(picture: Tensor, target: Tensor, ssim: SSIM, weight: float) -> Tensor:
    """The same layer by layer, wherever torch runs."""
    ssim.win = ssim.win.to(target.device)  # once: it would be copied there, and waited for, each time
    # Contiguous planes: on the interleaved colours of a large picture the same convolutions take much longer.
    planes = (image.permute(2, 0, 1)[None].contiguous() for image in (target, picture))
    return (1 - weight) * (picture - target).abs().mean() + weight * (1 - ssim(*planes))


@functools.cache
def _fuses(device: torch.device) -> bool:
    """Whether the kernels run there; says why not, once."""
    try:
        compiled(device)
    except BackendError as error:
        _log.warning("SSIM is made of convolutions, not by its kernel, on %s: %s", device, error)
        return False
    return True


def chain_losses(params: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What nothing needs becomes transparent and small, and can be moved (equation 10 of 3DGS-MCMC)."""
    return {
        "opacity_loss": MCMC_REGULARISER * params["opacities"].sigmoid().mean(),
        "scale_loss": MCMC_REGULARISER * params["scales"].exp().mean(),
    }
