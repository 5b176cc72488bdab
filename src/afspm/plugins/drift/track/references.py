"""Stored scans for comparison with later scans, and the choice of references for a scan."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from collections.abc import Mapping as Table
from dataclasses import dataclass, replace

from afspm.components import Array
from afspm.plugins.drift.pairs.overlap import overlap_ratio, sr_norm
from afspm.plugins.drift.registration import DriftScan

_LIKE = 0.5  # least ratio of the resolutions of scans of one kind


@dataclass(frozen=True, eq=False)
class ReferenceScan:
    """A scan stored as a reference.

    Attributes:
        compensated_m_s: (2,) velocity of tip coordinates during the scan, which followed the sample.
        anchor: whether the scan is the long-term reference for its part of the sample.
        adrift: whether the place of the scan is only predicted, since the scan matched no scan with a measured place.
        refusals: number of failed comparisons in a row, while another reference succeeded.
        used: number of the newest scan registered with this reference.
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
        recent: largest number of stored scans besides the anchors.
        anchors: largest number of anchors.
        most_bytes: largest memory for all stored values.
        overlap_min: least expected overlap for a comparison, as share of the smaller scan.
        sr_norm_min: least ratio of the resolutions for a comparison.
        stale_after: number of refusals in a row after which an anchor is removed.
        alike: least overlap of a scan with an anchor of similar resolution at which the scan needs no new anchor.
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
    """Stored scans in order of time. Displacements (…, 2) of the sample are in m."""

    def __init__(self, choice: Choice) -> None:
        self.choice = choice
        self.kept: list[ReferenceScan] = []

    def __len__(self) -> int:
        return len(self.kept)

    def __iter__(self) -> Iterator[ReferenceScan]:
        return iter(self.kept)

    def candidates(self, scan: DriftScan, drift_m: Array, drifts_m: Array, *, anywhere: bool) -> list[int]:
        """Return the indices of the references to compare with a scan, best first.

        References of similar resolution come first, and among these the largest expected overlap, in steps of a
        quarter. At equal overlap, anchors come first, then the newest scans, which show recent changes. Scans adrift,
        which are no evidence, come last.

        Args:
            drift_m: (2,) displacement expected in the scan.
            drifts_m: (n, 2) displacements in the references.
            anywhere: ignore the expected displacement, so that all references may overlap.
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
        """Return whether a reference has about the resolution of a scan, unlike an overview compared with a zoom."""
        return _alike(self.kept[number].scan, scan) >= _LIKE

    def judged(self, tried: Table[int, bool], step: int) -> None:
        """Update refusals and last use of each reference that was tried with the newest scan.

        Refusals only count if another reference succeeded.
        """
        for number, succeeded in tried.items():
            kept = self.kept[number]
            if succeeded:
                self.kept[number] = replace(kept, refusals=0, used=step)
            elif any(tried.values()):
                self.kept[number] = replace(kept, refusals=kept.refusals + 1)

    def known(self, numbers: Iterable[int]) -> None:
        """Clear the adrift flag of references with given indices."""
        for number in numbers:
            self.kept[number] = replace(self.kept[number], adrift=False)

    def needs_anchor(self, scan: DriftScan, drift_m: Array, drifts_m: Array) -> bool:
        """Return whether no anchor represents the area of a scan."""
        return not any(
            kept.anchor
            and self.is_alike(number, scan)
            and overlap_ratio(kept.scan.region, scan.region, drift_m - drifts_m[number]) >= self.choice.alike
            for number, kept in enumerate(self.kept)
        )

    def superfluous(self) -> int | None:
        """Return the index of a reference to remove; None if all can stay. The newest reference always stays."""
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
