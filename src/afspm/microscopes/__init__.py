"""Drivers of microscopes: a package for each vendor's controller, and the simulated ones."""
