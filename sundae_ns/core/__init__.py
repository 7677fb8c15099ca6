"""What everything stands on: errors, Gaussians, cameras, metrics, whole files."""
