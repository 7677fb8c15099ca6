"""More inputs of the head: the direction from the camera to what is seen, and its inverse distance, splatted as features are."""
import torch
from sundae_ns.compensation.head import CompensationHead, SIZES
from sundae_ns.compensation.unet import UNet
from sundae_ns.gaussians import FEATURES
from sundae_ns.rendering.source import LocalField

def install(directions: bool, distance: bool) -> None:
    extra = 3 * directions + distance
    primitives = LocalField.primitives
    def with_more(self, view, settings, *, features, colors=True, at=None):
        found = primitives(self, view, settings, features=features, colors=colors, at=at)
        if features:
            means = self.field["means"].detach()
            d = means - view.center
            length = d.norm(dim=1, keepdim=True).clamp_min(1e-6)
            parts = [self.field[FEATURES]]
            if directions: parts.append(d / length)
            if distance: parts.append(1 / (0.3 + length))
            found[FEATURES] = torch.cat(parts, dim=1)
        return found
    LocalField.primitives = with_more
    def build(self, config):
        config.validate(); self.config = config
        width, max_width = SIZES[config.size]
        self.net = UNet(config.num_features + 4 + extra, 3, width, max_width=max_width, pixel_unshuffle=config.pixel_unshuffle, zero_init=True)
        self.net.to(memory_format=torch.channels_last)
        self._accelerate()
    CompensationHead._build = build
