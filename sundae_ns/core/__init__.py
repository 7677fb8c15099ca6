"""The base of all rooms: errors, Gaussians, cameras, metrics, atomic files."""
