"""Tests of components in one process: the real scheduler core, a simulated microscope, a fake clock and network."""
