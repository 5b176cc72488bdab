"""The default estimator: all pixels at once, by generalised least squares."""

from __future__ import annotations

from afspm.drift.estimators.least_squares.estimator import LeastSquares

__all__ = ["LeastSquares"]
