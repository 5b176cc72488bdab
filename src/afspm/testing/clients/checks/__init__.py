"""Importing this package marks all checks."""

from __future__ import annotations

from afspm.testing.clients.checks import control, keys, launch, measure, replay, requests, wire  # noqa: F401
