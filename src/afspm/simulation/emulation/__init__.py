"""Vendors' controllers without a vendor: each speaks a real protocol, with the simulated physics behind it."""

from __future__ import annotations
