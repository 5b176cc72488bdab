"""TODO: what storage holds."""
