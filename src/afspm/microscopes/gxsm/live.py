"""Lines of a running scan, from GXSM's memory: rows from the top, of the scan before where nothing was scanned yet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from afspm.microscopes.gxsm.link import Asking
from afspm.microscopes.gxsm.settings import ANGSTROM_M
from afspm.model import Region, ScanLines


def new_lines(
    ask: Asking,
    endings: Sequence[str],
    known: Mapping[str, Sequence[str]],
    taken: tuple[Region, tuple[int, int]],
    start: int,
    done: int,
) -> list[ScanLines]:
    """The lines from `start` to `done`, in the order in which they are scanned.

    GXSM tells neither names nor units of what it hands out: those of the files before are taken.

    Args:
        endings: of the channels' files, by number.
        known: name and unit of a channel, by the ending of its files.
        taken: the frame that is being scanned, and (rows, columns).
    """
    region, shape = taken
    count = min(done, shape[0]) - start
    if count < 1:
        return []
    images: dict[str, np.ndarray] = {}
    for channel, ending in enumerate(endings):
        if ending in known:
            found = ask.call("get_slice", channel, 0, 0, start, count)
            # of another shape: somebody has changed the next frame, and this one was found running
            if isinstance(found, np.ndarray) and found.shape == (count, shape[1]):
                images[ending] = found.astype(np.float64)
    lines = []
    for ending, image in images.items():
        name, unit = known[ending]
        rows = image[::-1] * (ANGSTROM_M if unit == "m" else 1.0)
        lines.append(ScanLines(region, shape, name, unit, shape[0] - start - count, rows))
    return lines
