"""Features that vary inside a primitive: the last 3 T columns are slopes of T features along the primitive's own axes.

Where a ray passes a primitive, the expected place in its own frame, in standard deviations, is linear in the pixel:
z(q) = M^T J^T (J M M^T J^T + 0.3 I)^-1 (q - u), M = V R S. So a feature g . z(q) blends as three channels, -a . u and a, with a = A^T g.
"""
import sys
from dataclasses import replace
import torch
import sundae_ns.training.step as step_module
from sundae_ns.compensation.head import CompensationHead, SIZES
from sundae_ns.compensation.unet import UNet
from sundae_ns.gaussians import FEATURES
from sundae_ns.gaussians.rotations import rotation_matrices
from sundae_ns.rendering.source import LocalField
render_module = sys.modules["sundae_ns.rendering.render"]

def slopes(field, view):
    """u [N, 2] and A [N, 3, 2]."""
    means, quats, scales = field["means"], field["quats"], field["scales"].exp()
    V = view.viewmat.to(means)
    c = means @ V[:3, :3].T + V[:3, 3]
    z = c[:, 2].clamp_min(0.01)
    K = view.K.to(means)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    u = torch.stack([fx * c[:, 0] / z + cx, fy * c[:, 1] / z + cy], -1)
    lim_x = 0.15 * view.width / fx; lim_y = 0.15 * view.height / fy
    tx = (c[:, 0] / z).clamp(-cx / fx - lim_x, (view.width - cx) / fx + lim_x)
    ty = (c[:, 1] / z).clamp(-cy / fy - lim_y, (view.height - cy) / fy + lim_y)
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * tx / z, zero, fy / z, -fy * ty / z], -1).view(-1, 2, 3)
    M = V[:3, :3] @ rotation_matrices(quats) * scales[:, None, :]
    P = J @ M
    cov = P @ P.transpose(1, 2)
    a, b, d = cov[:, 0, 0] + 0.3, cov[:, 0, 1], cov[:, 1, 1] + 0.3
    det = (a * d - b * b).clamp_min(1e-12)
    inv = torch.stack([d, -b, -b, a], -1).view(-1, 2, 2) / det[:, None, None]
    return u, P.transpose(1, 2) @ inv

def channels(features, field, view, T, through):
    with torch.set_grad_enabled(through and torch.is_grad_enabled()):
        u, A = slopes(field, view)
        u = u - torch.tensor([view.width / 2, view.height / 2]).to(u)
        ok = torch.isfinite(A).all(-1).all(-1) & (u.abs().amax(-1) < 1e5)
        A = torch.where(ok[:, None, None], A, torch.zeros_like(A)); u = torch.where(ok[:, None], u, torch.zeros_like(u))
    n, f = features.shape
    g = features[:, f - 3 * T:].view(n, T, 3)
    a = g @ A  # [N, T, 2]
    const = -(a * u[:, None]).sum(-1, keepdim=True)
    return torch.cat([features[:, : f - 3 * T], torch.cat([const, a], -1).reshape(n, 3 * T)], 1)

def install(T, through=False):
    primitives = LocalField.primitives
    def textured(self, view, settings, *, features, colors=True, at=None):
        found = primitives(self, view, settings, features=features, colors=colors, at=at)
        if features:
            found[FEATURES] = channels(self.field[FEATURES], self.field, view, T, through)
        return found
    LocalField.primitives = textured
    old = render_module.compensate
    def compensate(head, base, splatted, background, *, training):
        colors = splatted.colors
        h, w, c = colors.shape
        x = torch.arange(w, device=colors.device) + 0.5 - w / 2
        y = torch.arange(h, device=colors.device) + 0.5 - h / 2
        s = colors[..., c - 3 * T:].view(h, w, T, 3)
        t = s[..., 0] + x[None, :, None] * s[..., 1] + y[:, None, None] * s[..., 2]
        return old(head, base, replace(splatted, colors=torch.cat([colors[..., : c - 3 * T], t], -1)), background, training=training)
    render_module.compensate = step_module.compensate = compensate
    def build(self, config):
        config.validate(); self.config = config
        width, max_width = SIZES[config.size]
        self.net = UNet(config.num_features - 2 * T + 4, 3, width, max_width=max_width, pixel_unshuffle=config.pixel_unshuffle, zero_init=True)
        self.net.to(memory_format=torch.channels_last)
        self._accelerate()
    CompensationHead._build = build
