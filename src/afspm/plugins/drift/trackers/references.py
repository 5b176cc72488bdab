"""The scans stored for comparison with later ones, and the choice of references for a scan."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from collections.abc import Mapping as Table
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from afspm.plugins.drift.overlap import overlap_ratio, sr_norm
from afspm.plugins.drift.registration import DriftScan

Array = NDArray[np.float64]

_LIKE = 0.5  # least ratio of the resolutions of scans of one kind


@dataclass(frozen=True, eq=False)
class ReferenceScan:
    """A stored scan.

    Attributes:
        compensated_m_s: (2,) velocity with which tip coordinates followed the sample then.
        anchor: whether it stands for its part of the sample.
        adrift: no scan with a measured place matched it, so its place is a prediction.
        refusals: comparisons in a row without success, while another reference succeeded.
        used: number of the scan that was last registered with it.
    """

    scan: DriftScan
    compensated_m_s: Array
    anchor: bool
    adrift: bool = False
    refusals: int = 0
    used: int = 0


@dataclass(frozen=True)
class Choice:
    """Settings for storing and choosing references.

    Attributes:
        compared: largest number of references for each scan.
        recent: stored scans besides the anchors.
        anchors: largest number of anchors.
        most_bytes: of all stored values.
        overlap_min: least overlap, as share of the smaller scan.
        sr_norm_min: least ratio of the resolutions.
        stale_after: refusals in a row after which an anchor is removed.
        alike: share of a scan that an anchor must show, at half its resolution at least, to stand for it.
    """

    compared: int = 5
    recent: int = 4
    anchors: int = 8
    most_bytes: int = 256_000_000
    overlap_min: float = 0.3
    sr_norm_min: float = 0.05
    stale_after: int = 3
    alike: float = 0.6


class ReferenceScans:
    """The stored scans, in the order of time. Displacements (…, 2) of the sample are in m."""

    def __init__(self, choice: Choice) -> None:
        self.choice = choice
        self.kept: list[ReferenceScan] = []

    def __len__(self) -> int:
        return len(self.kept)

    def __iter__(self) -> Iterator[ReferenceScan]:
        return iter(self.kept)

    def candidates(self, scan: DriftScan, drift_m: Array, drifts_m: Array, *, anywhere: bool) -> list[int]:
        """Return the numbers of the references to compare with a scan, best first.

        Scans adrift, which are no evidence, come last. Anchors of the same resolution come first, then the newest,
        which show recent changes.

        Args:
            drift_m: (2,) expected in the scan.
            drifts_m: (n, 2) shown by the references.
            anywhere: ignore the expectation, so all may overlap.
        """
        fitting = []
        for number, kept in enumerate(self.kept):
            if _alike(kept.scan, scan) < self.choice.sr_norm_min:
                continue
            shared = overlap_ratio(kept.scan.region, scan.region, drift_m - drifts_m[number])
            if anywhere or shared >= self.choice.overlap_min:
                other_kind = not self.is_alike(number, scan)
                rank = (
                    kept.adrift,
                    other_kind,
                    -round(4 * shared),
                    not kept.anchor,
                    number if kept.anchor else -number,
                )
                fitting.append((rank, number))
        return [number for _, number in sorted(fitting)][: self.choice.compared]

    def is_alike(self, number: int, scan: DriftScan) -> bool:
        """Return whether a reference has about the resolution of a scan, unlike an overview of a zoom."""
        return _alike(self.kept[number].scan, scan) >= _LIKE

    def judged(self, tried: Table[int, bool], step: int) -> None:
        """Update the refusals and the last use of each reference tried with the newest scan."""
        for number, succeeded in tried.items():
            kept = self.kept[number]
            if succeeded:
                self.kept[number] = replace(kept, refusals=0, used=step)
            elif any(tried.values()):
                self.kept[number] = replace(kept, refusals=kept.refusals + 1)

    def known(self, numbers: Iterable[int]) -> None:
        """Clear the adrift flag of references."""
        for number in numbers:
            self.kept[number] = replace(self.kept[number], adrift=False)

    def needs_anchor(self, scan: DriftScan, drift_m: Array, drifts_m: Array) -> bool:
        """Return whether no anchor stands for the area of a scan."""
        return not any(
            kept.anchor
            and self.is_alike(number, scan)
            and overlap_ratio(kept.scan.region, scan.region, drift_m - drifts_m[number]) >= self.choice.alike
            for number, kept in enumerate(self.kept)
        )

    def superfluous(self) -> int | None:
        """Return the number of a reference to remove; None if all may stay. The newest always stays."""
        old = list(enumerate(self.kept))[:-1]
        stale = [n for n, one in old if one.anchor and one.refusals >= self.choice.stale_after]
        if stale:
            return stale[0]
        recent = [n for n, one in old if not one.anchor]
        anchors = sorted((one.used, n) for n, one in old if one.anchor)
        too_much = sum(one.scan.values.nbytes for one in self.kept) > self.choice.most_bytes
        if recent and (too_much or len(recent) + (not self.kept[-1].anchor) > self.choice.recent):
            return recent[0]
        if anchors and (too_much or len(anchors) + self.kept[-1].anchor > self.choice.anchors):
            return anchors[0][1]
        return None


def _alike(first: DriftScan, second: DriftScan) -> float:
    return sr_norm(first.region, first.values.shape, second.region, second.values.shape)
