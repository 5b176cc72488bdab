"""Emulated controllers of vendors: each speaks a real protocol, with the simulated instrument behind it."""

from __future__ import annotations
