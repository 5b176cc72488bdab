"""The planned work of an experiment as lines for the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import datetime, timedelta

from afspm.basics.formatting import counted, duration_text, quantity
from afspm.model.planned_work import PlannedWork, planned_end_s

COMPUTING_S = 0.1
"""Real time between two scans that have no period: measured 0.04 to 0.14 s on an idle computer of two cores."""


def estimate_lines(works: Mapping[str, PlannedWork | None], speed: float, now: datetime) -> Iterator[str]:
    """Yield a line for each component, then one for the end.

    Args:
        speed: experiment seconds in a real second.
        now: start of the experiment, real time.
    """
    for name, work in works.items():
        yield f"no estimate for {name}" if work is None else f"{name} plans {work_text(work)}"
    end_s = planned_end_s(works.values())
    if end_s is None:
        return
    planned = [work for work in works.values() if work is not None]
    bound = "at the latest about" if any(work.at_most for work in planned) else "about"
    end = now + timedelta(seconds=end_s / speed)
    real = f", {duration_text(end_s / speed)} real" if speed != 1.0 else ""
    computing = "" if speed <= 1.0 else f"; at {speed:g} x also without computing, about {COMPUTING_S:g} s real a scan"
    yield (
        f"started now it would end {bound} {end.astimezone():%Y-%m-%d %H:%M} ({duration_text(end_s)}{real}),"
        f" without repairs, rescans and waiting for control{computing}"
    )


def work_text(work: PlannedWork) -> str:
    """Return the work of a component in one line."""
    parts = []
    if work.scans is None:
        parts.append("scans without end")
    elif work.scans:
        parts.append(counted(work.scans, "scan"))
    if work.spectra:
        parts.append(counted(work.spectra, "spectrum", "spectra"))
    if work.path_m:
        parts.append(f"{quantity(work.path_m, 'm', 3)} scanned")
    if work.bytes_a_channel:
        parts.append(f"{work.bytes_a_channel / 1e6:.3g} MB a channel before compression")
    if work.scans:
        beside = " beside the spectra" if work.spectra else ""
        took = "unknown duration" if work.duration_s is None else duration_text(work.duration_s)
        parts.append(took + beside)
    bound = "at most " if work.at_most else ""
    return bound + ", ".join(parts) + (f" ({work.why})" if work.why else "")
