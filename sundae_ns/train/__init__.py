"""Training: state, step, densification, pruning, trials."""
