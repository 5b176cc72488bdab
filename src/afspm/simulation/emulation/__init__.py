"""Emulated controllers of vendors: each speaks a real protocol and controls the simulated instrument."""

from __future__ import annotations
