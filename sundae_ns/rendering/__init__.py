"""From a field to images: views, render settings, one splatting pass, the head, replay of recorded frames. Floor 4."""
