"""Facts beside the picture of a scan: its number, time and place, and the parameters at its start."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from afspm.basics import NS_PER_S, duration_text, quantity, scale, time_of_day, typeset, typeset_area
from afspm.components import SD_PER_MAD
from afspm.model import RETRACE, XY, ActByHand, ChannelRoles, TipStatus
from afspm.night import Overview, ScanSummary
from afspm.plugins.web.frames import ChannelFrame

_MOST_LINES = 512
_LAST_LINES, _FEWEST = 32, 8
Facts = list[tuple[str, str]]
"""Pairs of label and text."""


def scan_facts(
    frame: ChannelFrame, overview: Overview, conditions: Mapping[str, str], now_ns: int, roles: ChannelRoles
) -> Facts:
    """Return the facts about a scan, by label.

    Args:
        conditions: label and text of the parameters read at its start. Without any, the recorded setpoint is used.
        roles: the microscope's channels by their roles, which tell a retrace.
    """
    region, (rows, columns) = frame.region, frame.values.shape
    size = ("Size", typeset_area(region.size_m))
    angle = [("Angle", f"{math.degrees(region.angle_rad):.4g}°")] if region.angle_rad else []
    return [
        ("Channel", _channel(frame.channel, roles)),
        *_when(frame, overview, now_ns),
        size,
        ("Centre", _centre(region.center_m)),
        *angle,
        ("Pixels", f"{columns} × {rows}"),
        *_unrest(frame),
        *(conditions or _recorded(frame, overview)).items(),
        *_tip_of_scan(frame, overview),
        *(("Note", note.text) for note in overview.notes if frame.time_ns and note.scan_ns == frame.time_ns),
    ]


def tip_facts(ends: Sequence[TipStatus | None], acts: Iterable[ActByHand]) -> Facts:
    """Return the tip and its feedback at the begin and the end, and each act at the microscope meanwhile.

    Args:
        ends: the known states, in their order; equal ones are shown once.
    """
    known = dict.fromkeys(text for status in ends if status is not None and (text := _tip_text(status)))
    tip = [("Tip", " → ".join(known))] if known else []
    return [*tip, *(("By hand", str(act)) for act in acts)]


def _tip_text(status: TipStatus) -> str:
    tip = {True: "at the sample", False: "withdrawn", None: ""}[status.engaged]
    feedback = {True: "feedback on", False: "feedback off", None: ""}[status.feedback_on]
    return ", ".join(filter(None, (tip, feedback)))


def _tip_of_scan(frame: ChannelFrame, overview: Overview) -> Facts:
    if frame.time_ns is not None:
        one = overview.conditions(frame.time_ns)
        return [] if one is None else tip_facts((one.begin, one.end), one.acts)
    # a scan that is interrupted has no conditions: its acts are those between its begin and its interruption
    last = overview.scans[-1] if overview.running is None and overview.scans else None
    until_ns = last.time_ns if last is not None and last.interrupted else overview.newest_ns
    began_ns = overview.newest_ns if frame.began_ns is None else frame.began_ns
    return tip_facts((), (act for act in overview.acts if began_ns <= act.time_ns <= until_ns))


def _unrest(frame: ChannelFrame) -> Facts:
    # every microscope has its z in scans, and not all have it elsewhere
    rows = frame.values
    if frame.newest_row is not None:  # the last lines, whichever way the scan goes
        rows = rows[max(0, frame.newest_row - _LAST_LINES + 1) : frame.newest_row + _LAST_LINES]
    rows = rows[-_MOST_LINES:]  # of a finished scan: the page waits for it
    rows = rows[np.isfinite(rows).all(axis=1)]
    if frame.unit != "m" or min(rows.shape) < _FEWEST:
        return []
    # for white noise a second difference has the variance 6, and a first one 2; slope and drift have none
    points_m = _rms(np.diff(rows, 2, axis=1)) / math.sqrt(6.0)
    steps_m = np.diff(np.median(rows, axis=1))
    lines_m = _rms(steps_m - np.median(steps_m)) / math.sqrt(2.0)
    if not min(points_m, lines_m) > 0.0:  # a height that is held, or rounded
        return []
    is_part = frame.newest_row is not None or len(frame.values) > _MOST_LINES
    where = f"{'last ' if frame.newest_row is not None else ''}{len(rows)} lines" if is_part else "all lines"
    shown = [typeset(quantity(one, "m", 2)) for one in (points_m, lines_m)]
    return [("Unrest of z", f"{shown[0]} point to point, {shown[1]} line to line ({where}, with the surface)")]


def _rms(differences: NDArray[np.float64]) -> float:
    # robust: single steps and scars do not count
    return float(SD_PER_MAD * np.median(np.abs(differences)))


def _channel(name: str, roles: ChannelRoles) -> str:
    is_retrace = any(role.endswith(RETRACE) for role in roles.of(name))
    return name + RETRACE if is_retrace and RETRACE.strip(", ") not in name.lower() else name


def _when(frame: ChannelFrame, overview: Overview, now_ns: int) -> Facts:
    if frame.time_ns is None:
        return _growing(frame, overview, now_ns)
    summary = summary_of(frame.time_ns, overview)
    facts = [("Scan", "" if summary is None else f"no. {summary.number}"), ("Finished", time_of_day(frame.time_ns))]
    if summary is not None and summary.began_ns is not None:
        facts.append(("Took", duration_text((summary.time_ns - summary.began_ns) / NS_PER_S)))
    if summary is not None and summary.holder:
        facts.append(("By", summary.holder))
    if summary is not None and summary.outside:
        facts.append(("Outside", ", ".join(summary.outside)))
    return [fact for fact in facts if fact[1]]


def _recorded(frame: ChannelFrame, overview: Overview) -> Mapping[str, str]:
    # the record has a setpoint without its unit, which no message contains
    summary = None if frame.time_ns is None else summary_of(frame.time_ns, overview)
    return {} if summary is None or summary.setpoint is None else {"Setpoint": f"{summary.setpoint:.4g}"}


def began_ns(frame: ChannelFrame, overview: Overview) -> int | None:
    """Return the start of a frame's scan; None if unknown."""
    if frame.time_ns is not None:
        summary = summary_of(frame.time_ns, overview)
    elif overview.running is not None:
        return overview.running.began_ns
    else:
        summary = overview.scans[-1] if overview.scans and overview.scans[-1].interrupted else None
    return None if summary is None else summary.began_ns


def _centre(xy_m: XY) -> str:
    factor, unit = scale(max(*map(abs, xy_m), 1e-9), "m")
    return typeset(f"({xy_m[0] * factor:.4g}, {xy_m[1] * factor:.4g}) {unit}")


def _growing(frame: ChannelFrame, overview: Overview, now_ns: int) -> Facts:
    # a scan is counted with its first published channel, or once it was interrupted
    number = overview.scan_count + (overview.running is not None and not overview.running.published)
    facts = [("Scan", f"no. {number}")]
    if frame.began_ns is not None:
        facts.append(("Began", time_of_day(frame.began_ns)))
    if (progress := overview.scan_progress(now_ns)) is not None:
        facts.append(("Ends", ends_text(progress[1], now_ns)))
    return [*facts, ("Lines", f"{frame.rows} of {frame.values.shape[0]}")]


def ends_text(left_ns: int, now_ns: int) -> str:
    """Return the end time with the time left: "22:14 (in 12 min)"."""
    return f"{time_of_day(now_ns + left_ns, seconds=left_ns < 600 * NS_PER_S)} (in {duration_text(left_ns / NS_PER_S)})"


def summary_of(time_ns: int, overview: Overview) -> ScanSummary | None:
    """Return the summary of the scan finished at a time; None if there is none."""
    return next((one for one in reversed(overview.scans) if one.time_ns == time_ns), None)
