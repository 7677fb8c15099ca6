"""What a run leaves on disk: checkpoints, its folder and its config.yml."""
