"""The graph on the Gaussians: neighbours, edges, spectral filters."""
