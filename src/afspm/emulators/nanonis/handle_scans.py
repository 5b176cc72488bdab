"""Scans."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from afspm.emulators.nanonis.dispatch import (
    Answer,
    DeferredResult,
    FunctionRefused,
    Results,
    answers,
    chosen,
    deadline_s,
)
from afspm.emulators.nanonis.panel import NanonisState
from afspm.simulation.scanning import MOST_PIXELS

_WAITED: Final = "waited"
"""What is remembered of a client: how many scans had ended, and when, before it waits for the next end."""
_PASTES: Final = (0, 1, 2)


@answers("Scan.Action")
def _action(panel: NanonisState, action: int, direction: int) -> Answer:
    now_s, scan = panel.clock.now_s(), panel.rig.scan
    if action == 0:
        if panel.scanning is not None:  # it begins anew
            panel.rig.stop_scan()
            panel.advance(now_s)
        panel.begin_scan(bool(direction))
        panel.client[_WAITED] = panel.ends, now_s
    elif action == 1:
        panel.rig.stop_scan()
    elif action == 2 and scan is not None:
        scan.pause(now_s)
    elif action == 3 and scan is not None:
        scan.resume(now_s)
    elif action == 6:
        panel.rig.move_probe(panel.frame[:2])
    elif action not in (2, 3, 4, 5):
        raise FunctionRefused(f"{action} is no action")
    return ()


@answers("Scan.StatusGet")
def _scan_status(panel: NanonisState) -> Answer:
    running = panel.scanning is not None and panel.scanning.scan.running(panel.clock.now_s())
    return (int(running),)


@answers("Scan.WaitEndOfScan")
def _wait_end_of_scan(panel: NanonisState, timeout_ms: int) -> Answer:
    """Wait for the next end of a scan; an earlier one does not count.

    A client's pause since it has begun the scan, or since its last wait has timed out, is taken to last as long in
    experiment time as it does in real time, as if the clock went no faster.
    """
    if panel.scanning is None and panel.faults.lasts("ends-at-once", panel.clock.now_s()):
        return 0, ""
    client, ends = panel.client, panel.ends
    ends_before, since_s = client.pop(_WAITED, (ends, 0.0))
    pause_s = panel.clock.real_s(panel.clock.now_s() - since_s)
    if ends > ends_before and panel.ended_s > since_s + pause_s:
        return 0, panel.last_path

    def gave_up() -> None:
        client[_WAITED] = panel.ends, panel.clock.now_s()

    until_s = deadline_s(panel, timeout_ms)
    return DeferredResult(lambda _: (0, panel.last_path) if panel.ends > ends else None, until_s, (1, ""), gave_up)


@answers("Scan.WaitEndOfLine")
def _wait_end_of_line(panel: NanonisState, timeout_ms: int) -> Answer:
    """Wait for the end of a line, forward (0) or backward (1), counted from 1."""
    scan = panel.rig.scan
    timed_out = (1, 0, 0, 0)
    if scan is None or not scan.running(panel.clock.now_s()):
        return timed_out
    passes = scan.passes(panel.clock.now_s())
    first_pass = 1

    def ready(now_s: float) -> Results | None:
        over = scan.passes(now_s) > passes or not scan.running(now_s)
        return (0, passes // 2 + 1, passes % 2, first_pass) if over else None

    def next_s(now_s: float) -> float:
        return now_s + scan.line_s / 2

    return DeferredResult(ready, deadline_s(panel, timeout_ms), timed_out, next_s=next_s)


@answers("Scan.FrameSet")
def _frame_set(panel: NanonisState, x: float, y: float, width: float, height: float, angle_deg: float) -> Answer:
    if not (min(width, height) > 0.0 and all(map(math.isfinite, (x, y, width, height, angle_deg)))):
        raise FunctionRefused("the frame is empty")
    panel.set_frame(x, y, width, height, angle_deg)
    return ()


@answers("Scan.FrameGet")
def _frame_get(panel: NanonisState) -> Answer:
    return panel.frame


@answers("Scan.BufferSet")
def _buffer_set(panel: NanonisState, channels: list[int], pixels: int, lines: int) -> Answer:
    if not all(0 <= channel < 128 for channel in channels) or not 1 <= pixels <= MOST_PIXELS or lines < 0:
        raise FunctionRefused("no such channel or number of pixels")
    panel.set_buffer(channels, pixels, lines)
    return ()


@answers("Scan.BufferGet")
def _buffer_get(panel: NanonisState) -> Answer:
    return panel.channels, panel.pixels, panel.lines


@answers("Scan.SpeedSet")
def _speed_set(panel: NanonisState, *speed: Any) -> Answer:
    """1 keeps the speed and 2 the time; which of both is kept says which of both counts now."""
    forward, backward, forward_s, backward_s, keep, ratio = speed
    keeps_time = panel.speed[4] if keep == 0 else keep - 1
    width = panel.frame[2]
    if not min(forward, backward, forward_s, backward_s) > 0.0 or keep > 2:
        raise FunctionRefused("no such speed")
    if keeps_time:
        forward, backward = width / forward_s, width / backward_s
    else:
        forward_s, backward_s = width / forward, width / backward
    panel.speed = (forward, backward, forward_s, backward_s, keeps_time, ratio)
    return ()


@answers("Scan.SpeedGet")
def _speed_get(panel: NanonisState) -> Answer:
    return panel.speed


@answers("Scan.PropsSet")
def _props_set(
    panel: NanonisState, continuous: int, bouncy: int, autosave: int, series: str, comment: str, *rest: Any
) -> Answer:
    panel.continuous = bool(chosen(continuous, panel.continuous, 1, 0))
    panel.bouncy = bool(chosen(bouncy, panel.bouncy, 1, 0))
    panel.autosave = chosen(autosave, panel.autosave, "all", "next", "off")
    panel.series, panel.comment = panel.name(series) or panel.series, comment
    if rest:
        panel.modules = rest[0]
    if rest[1:]:
        panel.autopaste = chosen(rest[1], panel.autopaste, *_PASTES)
    return ()


@answers("Scan.PropsGet")
def _props_get(panel: NanonisState) -> Answer:
    counts = [1] * len(panel.modules)
    table = [["Setpoint"] for _ in panel.modules]
    autosave = {"all": 0, "next": 1, "off": 2}[panel.autosave]
    flags = int(panel.continuous), int(panel.bouncy), autosave
    return *flags, panel.series, panel.comment, panel.modules, counts, table, panel.autopaste


@answers("Scan.FrameDataGrab")
def _frame_data_grab(panel: NanonisState, channel: int, forward: int) -> Answer:
    last = panel.last
    if channel not in (last.channels if last else panel.channels):
        raise FunctionRefused("the channel is not among the acquired ones")
    now_s = panel.clock.now_s()
    if last is None or last.scan.drawing:
        raw, upwards = np.full((panel.lines, panel.pixels), np.nan), True
    else:
        *_, there, back = panel.images(last, now_s)[channel]
        raw, upwards = (there if forward else back[:, ::-1]), last.scan.upwards
    rows = raw if panel.rows_as_recorded and upwards else raw[::-1]
    return panel.signals[channel], rows, int(upwards)


@answers("Scan.XYPosGet")
def _scan_position(panel: NanonisState, wait: int) -> Answer:
    return panel.rig.probe_at(panel.clock.now_s())


@answers("Scan.Save")
def _save(panel: NanonisState, wait: int, timeout_ms: int) -> Answer:
    if panel.last is None:
        raise FunctionRefused("there is no scan to save")
    panel.save_scan(panel.last, panel.clock.now_s())
    return (0,)
