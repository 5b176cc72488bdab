"""TODO: what client holds."""
