"""TODO: what process holds."""
