"""A pair of scans: on one pixel grid, levelled, freed from spikes, and warped half-way towards each other."""

from __future__ import annotations
