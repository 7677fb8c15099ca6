"""The library: load, save, render, prune, measure."""
