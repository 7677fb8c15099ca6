"""Files of a training run: checkpoints, its folder, and its ``config.yml``."""
