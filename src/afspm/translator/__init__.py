"""TODO: what translator holds."""
