"""The paper's default estimator with its published settings, for comparison; implemented here.

Differences from `plugins.drift.estimators.features.Brief`, which corrects them: scans are not prepared, corners lie on
pixels, all pairs within the RANSAC radius of 5 % of the scan count alike (9 px of 128, so mismatches do, too), and a
result only needs inliers within that same radius, which every result has.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from afspm.components import Array
from afspm.plugins.drift.pairs.overlap import overlap_center_m
from afspm.plugins.drift.registration import DriftScan, Prior, Registration
from afspm.plugins.drift.registration.keypoints import Descriptors, matched
from afspm.plugins.drift.registration.ransac import FORMS, Search

THRESHOLD = 0.05  # of the diagonal: of RANSAC, and of the score
ITERATIONS = 100


class PublishedBrief:
    """Harris corners, BRIEF, brute force with cross-check, and the mean displacement of the RANSAC inliers."""

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        """See `afspm.plugins.drift.registration.Estimator`; scans of one pixel size."""
        (a, first), (b, second) = (_described(each) for each in (reference, scan))
        pairs = matched(first, second)
        a, b = a[pairs[:, 0]], b[pairs[:, 1]]
        diagonal_m = math.hypot(*reference.region.size_m)
        search = Search(FORMS["translation"], ITERATIONS, bend_max=1.0, rng=np.random.default_rng(0))
        found = search.among(a, b, THRESHOLD * diagonal_m)
        if found is None:
            return Registration.refused("RANSAC found nothing")
        shift = found.transform.shift
        center = overlap_center_m(reference.region, scan.region, shift)
        if center is None:
            return Registration.refused("the matches that agree lie outside the overlap of the scans")
        score = float(np.hypot(*(b - a - shift)[found.inlier].T).mean()) / diagonal_m
        return Registration(
            accepted=score <= THRESHOLD,
            reason="" if score <= THRESHOLD else f"a score of {score:.3f}",
            displacement_m=shift,
            covariance_m2=(THRESHOLD * diagonal_m) ** 2 * np.eye(2),  # it has none
            linear=np.zeros((2, 2)),
            center_m=center,
        )


def _described(scan: DriftScan) -> tuple[Array, Descriptors]:
    # corners in tip coordinates, (n, 2), and descriptors; settings missing in the paper are the library's defaults
    from skimage import feature as untyped

    feature: Any = untyped
    corners = feature.corner_peaks(feature.corner_harris(scan.values))
    extractor = feature.BRIEF(rng=1)
    extractor.extract(scan.values, corners)
    kept = corners[extractor.mask]
    x, y = scan.region.pixels_m(scan.values.shape)
    at = np.stack([x[kept[:, 0], kept[:, 1]], y[kept[:, 0], kept[:, 1]]], axis=1)
    signs: Descriptors = np.where(extractor.descriptors, 0.5, -0.5).astype(np.float32)
    return at, signs
