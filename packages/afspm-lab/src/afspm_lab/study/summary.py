"""Summary of many nights: medians and spread, the best settings, and whether the defaults are as good."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np

BY = "misplaced rms"
"""Name of the metric for the ranking: rms misplacement of scans, once the rate is known."""


@dataclass(frozen=True)
class Summary:
    """Summary of the nights with one combination of settings.

    Attributes:
        label: name of the combination in the table.
        nights: number of completed nights.
        failed: errors of the nights that were not completed.
        quartiles: lower quartile, median and upper quartile, by metric.
        is_default, is_best: whether these settings are the defaults, and whether they are the best.
        holds: whether these are the defaults, and as good as the best: their median is not above its upper quartile.
    """

    label: str
    nights: int
    failed: tuple[str, ...]
    quartiles: Mapping[str, tuple[float, float, float]]
    is_default: bool = False
    is_best: bool = False
    holds: bool = False

    @property
    def median(self) -> float:
        """Median of the ranking metric; infinite without a completed night."""
        return self.quartiles[BY][1] if self.nights else float("inf")


def summarised(
    labels: Sequence[str], metrics: Mapping[str, Sequence[Mapping[str, float]]], failed: Mapping[str, Sequence[str]]
) -> list[Summary]:
    """Return one summary for each label, best first. The first label belongs to the defaults.

    Args:
        metrics: metrics of each night, by label. A night that lost the sample counts as infinitely bad in the ranking
            metric.
        failed: errors of nights that were not completed, by label.
    """
    rows = [_row(label, metrics.get(label, ()), failed.get(label, ()), labels[0]) for label in labels]
    rows.sort(key=lambda row: row.median)
    best = rows[0]
    upper = best.quartiles[BY][2] if best.nights else float("-inf")
    return [replace(row, is_best=row is best, holds=row.is_default and row.median <= upper) for row in rows]


def _row(label: str, nights: Sequence[Mapping[str, float]], failed: Sequence[str], default: str) -> Summary:
    quartiles = {name: _quartiles([_honest(one, name) for one in nights]) for name in (nights[0] if nights else ())}
    return Summary(label, len(nights), tuple(failed), quartiles, is_default=label == default)


def _honest(metrics: Mapping[str, float], name: str) -> float:
    return float("inf") if name == BY and metrics.get("lost") else metrics[name]


def _quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    # quartiles are values of the data: interpolation with infinity is impossible
    lower = float(np.percentile(values, 25, method="lower"))
    upper = float(np.percentile(values, 75, method="higher"))
    return lower, float(median(values)), upper
