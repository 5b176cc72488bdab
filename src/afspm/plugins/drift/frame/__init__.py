"""Drift compensation for a scheduler: a coordinate frame, a gate for scans, and a worker that registers them."""

from __future__ import annotations
