"""Guests: makers, drift, web and bridges; each joins by entry points, and nothing outside this folder imports it."""
