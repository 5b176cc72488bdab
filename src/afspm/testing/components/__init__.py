"""Tests of components in one process: real decisions, a simulated microscope, a fake clock, an in-memory network."""
