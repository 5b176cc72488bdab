"""Whether two scans do show the same place: an estimate is always found, also where there is none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.search import Correlation
from afspm.drift.estimators.least_squares.spectra import shared_information

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

RINGS_PX = (9, 16)


@dataclass(frozen=True)
class Evidence:
    """Figures of merit of a match; see `Limits`."""

    overlap: float
    sd_px: float
    gap: float
    information: float
    agreement: float
    correlation: float
    correlation_z: float
    correlation_gap: float
    edges_gap: float


@dataclass(frozen=True)
class Limits:
    """What a match must reach.

    Attributes:
        overlap, overlap_expected: of the smaller scan; the latter where there is a prior.
        sd_px: largest standard deviation of the shift.
        gap: how much likelier, in nats, than any other shift.
        information: mutual information of the aligned scans, nats.
        agreement: share of 4 x 4 parts of the overlap that correlate.
        correlation, correlation_z: of the aligned scans, and in standard deviations over what they give at 32 shifts
            about the match (surrogates), which a wrong match does no better than.
        correlation_gap: above the best of the surrogates; `edges_gap` the same of a band that favours edges.
    """

    overlap: float = 0.4
    overlap_expected: float = 0.2
    sd_px: float = 0.2
    gap: float = 1.0
    information: float = 60.0
    agreement: float = 0.6
    correlation: float = 0.4
    correlation_z: float = 2.5
    correlation_gap: float = 0.02
    edges_gap: float = 0.0

    def reason(self, found: Evidence, *, expected: bool) -> str:
        """Why a match is refused, in words; empty if it isn't."""
        overlap = self.overlap_expected if expected else self.overlap
        if found.overlap < overlap:
            return f"the scans overlap by {found.overlap:.0%} only, {overlap:.0%} are needed"
        if found.correlation < self.correlation or found.information < self.information:
            return f"no common features (correlation {found.correlation:.2f}, {found.information:.0f} nats in common)"
        if found.agreement < self.agreement:
            return f"only {found.agreement:.0%} of the overlap agree, {self.agreement:.0%} are needed"
        if found.gap < self.gap:
            return f"ambiguous: another displacement is almost as likely ({found.gap:.1f} nats less)"
        if found.correlation_z < self.correlation_z or found.correlation_gap < self.correlation_gap:
            return f"other displacements correlate as well ({found.correlation_z:.1f} standard deviations over them)"
        if found.edges_gap < self.edges_gap:
            return "the edges correlate better at another displacement"
        if not found.sd_px < self.sd_px:
            return f"too uncertain: {found.sd_px:.2f} px"
        return ""


def agreement(one: Array, two: Array, known: Mask) -> float:
    """Share of 4 x 4 parts of two aligned images whose correlation exceeds 0.2."""
    good = total = 0
    for rows in np.array_split(np.arange(one.shape[0]), 4):
        for columns in np.array_split(np.arange(one.shape[1]), 4):
            part = np.ix_(rows, columns)
            m = known[part]
            if m.sum() >= 16:
                total += 1
                good += correlated(one[part][m], two[part][m]) > 0.2
    return good / max(total, 1)


def correlated(one: Array, two: Array) -> float:
    """Pearson's coefficient."""
    a, b = one - one.mean(), two - two.mean()
    return float(a @ b / max(np.sqrt((a @ a) * (b @ b)), 1e-300))


def against_surrogates(one: Array, two: Array, known: Mask) -> tuple[float, float, float]:
    """Correlation of two aligned images, and how far it stands out from that at 32 shifts on two rings.

    Returns:
        correlation; its distance from the mean of the others in their standard deviations; and from the best of them.
    """
    correlation = Correlation(known, known).of(one, two)
    cy, cx = np.array(known.shape) - 1
    others = []
    for radius in RINGS_PX:
        angles = 2.0 * np.pi * np.arange(16) / 16
        y, x = np.rint(radius * np.sin(angles)).astype(int) + cy, np.rint(radius * np.cos(angles)).astype(int) + cx
        inside = (y >= 0) & (y < correlation.shape[0]) & (x >= 0) & (x < correlation.shape[1])
        others += correlation[y[inside], x[inside]].tolist()
    here, surrogates = float(correlation[cy, cx]), np.array(others)
    return here, float((here - surrogates.mean()) / max(surrogates.std(), 1e-6)), float(here - surrogates.max())


def information(one: Array, two: Array, known: Mask) -> float:
    """See `shared_information`; what is not known counts as zero in both."""
    return shared_information(one * known, two * known)
