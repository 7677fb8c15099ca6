"""The steps of a prune: score, select, merge, decide."""
