"""What makes a scheduler drift compensated: a frame, a gate for scans, and a worker that registers them."""

from __future__ import annotations
