"""Doubt of a registration: its covariance, the probability that its match is wrong, and the reasons to refuse it."""

from __future__ import annotations
