"""Whether a scan is to be taken again, because it shows another part of the sample than was asked for.

Both rules compare, in sample coordinates, the region that was asked for with the one that turned out to have been
scanned: `update.after.mapping.to_sample(region in tip coordinates)`. They give the reason for a person, or nothing.
"""

from __future__ import annotations

import numpy as np

from afspm.drift.overlap import intersection_ratio
from afspm.errors import InvalidValue
from afspm.model import Frame, Region

F_RESCAN = 0.75


def too_little_shared(asked: Region, scanned: Region, f_rescan: float = F_RESCAN) -> str:
    """The rule of the paper ("Overarching Workflow"): f' = intersection_ratio(r', r) below f_rescan.

    Raises:
        InvalidValue: a region that is not in sample coordinates.
    """
    _in_sample(asked, scanned)
    shared = intersection_ratio(asked, scanned)
    if shared >= f_rescan:
        return ""
    return f"it shows {shared:.0%} of the region that was asked for, less than {f_rescan:.0%}"


def too_far_off(asked: Region, scanned: Region, sd_m: float, tolerance_m: float) -> str:
    """Whether the corner that is furthest off may be further off than is tolerated.

    The paper's rule lets a scan be off by an eighth of its size. Here the user says how much it may be, and what is
    uncertain counts: |residual| + 2 sd > tolerance.

    Args:
        sd_m: standard deviation of the position that was found, `update.after.sd_m`.

    Raises:
        InvalidValue: a region that is not in sample coordinates, or a tolerance that is not above zero.
    """
    _in_sample(asked, scanned)
    if not tolerance_m > 0.0:
        raise InvalidValue(f"a tolerance of {tolerance_m} m", hint="above zero")
    off_m = float(np.linalg.norm(asked.corners_m() - scanned.corners_m(), axis=1).max())
    if off_m + 2.0 * sd_m <= tolerance_m:
        return ""
    tolerated = f"{tolerance_m * 1e9:.3g} nm is tolerated"
    return f"it is {off_m * 1e9:.3g} nm off (standard deviation {sd_m * 1e9:.2g} nm), {tolerated}"


def _in_sample(*regions: Region) -> None:
    for region in regions:
        if region.frame is not Frame.SAMPLE:
            raise InvalidValue(f"a region in {region.frame.value} coordinates can't be judged", hint="map it first")
