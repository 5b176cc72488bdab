"""The Scan module: frame, buffer, speed, properties, the running scan and its file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from afspm.basics import InvalidValue
from afspm.emulation import MOST_PIXELS, RETRACE, InstrumentBusy, ScanActivity
from afspm.model import Region
from afspm.plugins.nanonis.emulator import as_reported, files
from afspm.plugins.nanonis.emulator.core import GAIN_M, NanonisCore
from afspm.plugins.nanonis.emulator.dispatch import (
    Answer,
    DeferredResult,
    FunctionRefused,
    OtherLayout,
    Results,
    answers,
    chosen,
)
from afspm.plugins.nanonis.emulator.session import checked_name
from afspm.plugins.nanonis.emulator.signals import CHANNELS, Signals, name_and_unit

Image = tuple[str, str, np.ndarray, np.ndarray]
"""Name, unit, values forward and backward [y, x]."""
_PIXELS_AT_ONCE: Final = 16
_WAITED: Final = "waited"
_UNRECORDED: Final = 24
"""A channel that a person has chosen while a scan runs."""
"""Key in a client's memory: (number of ended scans, time) at its last start of a scan, or at its last timeout."""
_PASTES: Final = (0, 1, 2)
_SMALLEST_M: Final = 2e-12
"""Smallest side of a frame: half of it is the shortest line distance of the simulated scanner."""
_AUTOSAVE: Final = ("all", "next", "off")


@dataclass
class StartedScan:
    """A scan with the frame, line durations forward and backward in s, and channels at its start."""

    scan: ScanActivity
    frame: tuple[float, float, float, float, float]
    line_s: tuple[float, float]
    channels: list[int]


@dataclass
class ScanProperties:
    """The properties behind `Scan.PropsSet`; `autosave` is "all", "next" or "off"."""

    continuous: bool = False
    bouncy: bool = False
    autosave: str = "all"
    series: str = "unnamed"
    comment: str = ""
    modules: tuple[str, ...] = ("Z-Controller",)
    autopaste: int = 2


class ScanFiles:
    """Images of scans, and their files."""

    def __init__(self, core: NanonisCore, signals: Signals) -> None:
        self._core, self._signals = core, signals

    def images(self, started: StartedScan, until_s: float | None) -> dict[int, Image]:
        """Return the image of each recorded channel at a time; lines not yet scanned are NaN.

        A channel that the simulated instrument lacks is zero.
        """
        drawn = started.scan.channels(until_s)
        found: dict[int, Image] = {}
        for channel, (unit, values) in drawn.items():
            if channel in CHANNELS:
                back = drawn.get(f"{channel}{RETRACE}", (unit, values))[1]
                found[CHANNELS[channel]] = (self._signals.called.get(channel, channel), unit, values, back)
        nothing = np.zeros(started.scan.shape)
        for index in started.channels:
            if index not in found:
                found[index] = (*name_and_unit(self._signals.names[index]), nothing, nothing)
        return {index: found[index] for index in started.channels}

    def save(self, ended: StartedScan, properties: ScanProperties, now_s: float) -> str:
        """Save a scan; return the path that the controller reports, empty if no file can be written."""
        session, scan, feedback = self._core.session, ended.scan, ended.scan.feedback
        name = session.next_name(properties.series, 3, ".sxm")
        path = session.path_of(name)
        images = self.images(ended, scan.stopped_s)
        controller, unit = self._core.z_controller_name
        gains = (GAIN_M * (feedback.proportional_gain or 0.0), GAIN_M * (feedback.integral_gain or 0.0))
        content = files.SxmContent(
            path=path,
            start_s=self._core.file_clock.shown_s(scan.start_s),
            duration_s=scan.end_s - scan.start_s,
            center_m=ended.frame[:2],
            range_m=ended.frame[2:4],
            angle_deg=ended.frame[4],
            upwards=scan.upwards,
            line_s=ended.line_s,
            bias_v=scan.bias_v,
            z_controller=(controller, bool(feedback.on), feedback.setpoint or 0.0, unit, *gains),
            comment=properties.comment,
            channels=[(index, *image) for index, image in images.items()],
            settings=self._header(ended, properties, images),
        )
        return path if session.save(name, files.sxm(content), now_s) else ""

    def _header(self, ended: StartedScan, properties: ScanProperties, images: Mapping[int, Image]) -> dict[str, str]:
        scan, number = ended.scan, files.engineering
        return {
            "NanonisMain>Session Path": self._core.session.path,
            "NanonisMain>SW Version": "Generic 5",
            "Bias>Bias (V)": number(scan.bias_v),
            "Z-Controller>Controller status": "ON" if scan.feedback.on else "OFF",
            "Z-Controller>Setpoint": number(scan.feedback.setpoint or 0.0),
            "Scan>Scanfield": ";".join(number(value) for value in ended.frame),
            "Scan>series name": properties.series,
            "Scan>channels": ";".join(f"{name} ({unit})" for name, unit, _, _ in images.values()),
            "Scan>pixels/line": str(scan.shape[1]),
            "Scan>lines": str(scan.shape[0]),
            "Scan>speed forw. (m/s)": number(ended.frame[2] / ended.line_s[0]),
            "Scan>speed backw. (m/s)": number(ended.frame[2] / ended.line_s[1]),
        }


class ScanModule:
    """The functions of the Scan module, and the running scan.

    Args:
        rows_as_recorded: True if `Scan.FrameDataGrab` returns rows as recorded, False for the top row first.
        unscanned: value of rows not yet scanned in `Scan.FrameDataGrab`.
        clips_frames: True if frames are clipped to the scanner's range when they are set.

    Attributes:
        frame: x, y, width, height in m, angle clockwise in degrees.
        speed: forward and backward speed in m/s; forward and backward time per line in s; 1 if a change of the frame
            keeps the times, 0 if it keeps the speeds; ratio of the speeds.
        running: the running scan; None without a scan.
        last: the last started scan; None before the first.
        ends: number of ended scans, completed or stopped.
    """

    def __init__(
        self, core: NanonisCore, signals: Signals, *, rows_as_recorded: bool, unscanned: float, clips_frames: bool
    ) -> None:
        self._core, self._signals, self._files = core, signals, ScanFiles(core, signals)
        self._rows_as_recorded, self._unscanned = rows_as_recorded, unscanned
        self._clips_frames = clips_frames
        self.channels = sorted(CHANNELS[name] for name in core.rig.channels if name in CHANNELS)
        self.pixels, self.lines = 128, 128
        self.frame = (0.0, 0.0, 1e-6, 1e-6, 0.0)
        self.speed = (2e-6, 2e-6, 0.5, 0.5, 0, 1.0)
        self.properties = ScanProperties()
        self.properties.continuous = as_reported.CONTINUOUS in core.reported
        if as_reported.CODE_PAGE in core.reported:
            self.properties.comment = as_reported.COMMENT
        self.running: StartedScan | None = None
        self.last: StartedScan | None = None
        self.ends, self._last_end = 0, (-math.inf, "")
        self._delayed_start: tuple[float, bool] | None = None

    # --- the running scan ---

    def advance(self, now_s: float) -> float | None:
        """Start and end due scans; return the start time of a delayed scan, None without a delayed scan."""
        if self.running is not None and self._core.faults.strikes("panel-stop", now_s):
            self._core.rig.stop_scan(now_s)
        if self._delayed_start is not None and now_s >= self._delayed_start[0]:
            (_, upwards), self._delayed_start = self._delayed_start, None
            self._start_without_client(upwards)
        if self.running is not None and not self.running.scan.running(now_s):
            self._end(self.running, now_s)
        return None if self._delayed_start is None else self._delayed_start[0]

    def start(self, upwards: bool) -> None:
        """Start a scan at once. Raises InstrumentBusy; InvalidValue: no scan is possible with these settings."""
        x, y, width, height, clockwise_deg = self.frame
        rig = self._core.rig
        size_m = (width * (self.pixels - 1) / self.pixels, height * max(self.lines - 1, 1) / self.lines)
        if as_reported.OFFSET_IN_VOLTS in self._core.reported:
            x, y = as_reported.IN_VOLTS * x, as_reported.IN_VOLTS * y
        turned = 1.0 if as_reported.COUNTER_CLOCKWISE in self._core.reported else -1.0
        rig.setup.region = Region((x, y), size_m, turned * math.radians(clockwise_deg))
        rig.setup.shape = (self.lines, self.pixels)
        rig.setup.reach_m = self._core.reach_m
        forward_s, backward_s = self.speed[2:4]
        rig.setup.line_s, rig.setup.upwards = forward_s + backward_s, upwards
        scan = rig.start_scan(self._core.now_s)
        self.running = self.last = StartedScan(scan, self.frame, (forward_s, backward_s), list(self.channels))

    @answers("Scan.Action")
    def _action(self, action: int, direction: int) -> Answer:
        now_s, rig = self._core.now_s, self._core.rig
        if action == 0:
            if self.running is not None:  # the running scan is restarted
                rig.stop_scan(now_s)
                self.advance(now_s)
            self._start_on_request(bool(direction), now_s)
            self._core.client[_WAITED] = self.ends, now_s
        elif action == 1 and as_reported.DEAF_STOP not in self._core.reported:
            rig.stop_scan(now_s)
        elif action == 2 and rig.scan is not None:
            rig.scan.pause(now_s)
        elif action == 3 and rig.scan is not None:
            rig.scan.resume(now_s)
        elif action == 6:
            rig.move_probe(self.frame[:2], now_s)
        elif action not in (1, 2, 3, 4, 5):
            raise FunctionRefused(f"{action} is not an action")
        return ()

    def _start_on_request(self, upwards: bool, now_s: float) -> None:
        late = self._core.faults.strikes("late-start", now_s)
        if late is not None:
            self._delayed_start = (now_s + late.duration_s, upwards)
        elif not self._core.faults.strikes("no-start", now_s):
            self.start(upwards)

    def _start_without_client(self, upwards: bool) -> None:
        # No request is open that could be refused, and FrameSet accepts frames that can't be scanned.
        try:
            self.start(upwards)
        except (InstrumentBusy, InvalidValue) as error:
            self._core.log.warning("the scan does not begin: %s", error)

    def _end(self, ended: StartedScan, now_s: float) -> None:
        self.running = None
        finished = ended.scan.stopped_s is None
        path = self._files.save(ended, self.properties, now_s) if finished and self._saves(now_s) else ""
        if path and self._core.faults.strikes("stale-name", now_s):
            path = self._last_end[1]
        self.ends, self._last_end = self.ends + 1, (ended.scan.end_s, path)
        if finished and self.properties.continuous:
            self._start_without_client(ended.scan.upwards != self.properties.bouncy)

    def _saves(self, now_s: float) -> bool:
        if self.properties.autosave == "off" or self._core.faults.lasts("autosave-off", now_s):
            return False
        if self.properties.autosave == "next":
            self.properties.autosave = "off"
        return True

    @answers("Scan.StatusGet")
    def _status(self) -> Answer:
        core = self._core
        hides_s = core.rig.scan.start_s + as_reported.LATE_S if core.rig.scan is not None else -math.inf
        if as_reported.LATE_STATUS in core.reported and core.now_s < hides_s:
            return (0,)
        return (int(self.running is not None and self.running.scan.running(core.now_s)),)

    @answers("Scan.XYPosGet")
    def _position(self, wait: int) -> Answer:
        return self._core.rig.probe_at(self._core.now_s)

    @answers("Scan.WaitEndOfScan")
    def _wait_end_of_scan(self, timeout_ms: int) -> Answer:
        # The next end of a scan counts, not an earlier one. A client's pause since its start of the scan, or since its
        # last timeout, counts as long in experiment time as in real time: a fast clock must not let a scan end between
        # two waits.
        core, client, ends = self._core, self._core.client, self.ends
        if self.running is None and core.faults.lasts("ends-at-once", core.now_s):
            return 0, ""
        ends_before, since_s = client.pop(_WAITED, (ends, 0.0))
        pause_s = core.clock.real_s(core.now_s - since_s)
        ended_s, path = self._last_end
        if ends > ends_before and ended_s > since_s + pause_s:
            return 0, path

        def gave_up() -> None:
            client[_WAITED] = self.ends, core.now_s

        def ready(now_s: float) -> Results | None:
            return (0, self._last_end[1]) if self.ends > ends else None

        return DeferredResult(ready, core.deadline_s(timeout_ms), (1, ""), gave_up)

    @answers("Scan.WaitEndOfLine")
    def _wait_end_of_line(self, timeout_ms: int) -> Answer:
        # Lines are counted from 1; direction 0 is forward, 1 backward.
        scan = self._core.rig.scan
        timed_out = (1, 0, 0, 0)
        if scan is None or not scan.running(self._core.now_s):
            return timed_out
        passes = scan.passes(self._core.now_s)
        first_pass = 1

        def ready(now_s: float) -> Results | None:
            over = scan.passes(now_s) > passes or not scan.running(now_s)
            return (0, passes // 2 + 1, passes % 2, first_pass) if over else None

        def next_s(now_s: float) -> float:
            return now_s + scan.line_s / 2

        return DeferredResult(ready, self._core.deadline_s(timeout_ms), timed_out, next_s=next_s)

    # --- settings ---

    @answers("Scan.FrameSet")
    def set_frame(self, x: float, y: float, width: float, height: float, angle_deg: float) -> Answer:
        """Set the frame, also beyond the scanner's range unless `clips_frames`: the output of a scan is clipped.

        A real one clips the voltages while it scans; the emulator scans the frame as it was set
        (! frame-beyond-range, frame-bounds).
        """
        smallest_m = 0.0 if self._core.takes_all else _SMALLEST_M
        if not (min(width, height) >= smallest_m and all(map(math.isfinite, (x, y, width, height, angle_deg)))):
            raise FunctionRefused(
                f"a frame of {width:g} m x {height:g} m can't be scanned: its sides must be at least {_SMALLEST_M:g} m"
            )
        if self._clips_frames:
            range_m = self._core.range_m[:2]
            width, height = min(width, range_m[0]), min(height, range_m[1])
            x, y = (
                float(np.float32(np.clip(value, (size - whole) / 2, (whole - size) / 2)))
                for value, size, whole in zip((x, y), (width, height), range_m, strict=True)
            )
        self.frame = (x, y, width, height, angle_deg)
        *speeds, keeps_time, ratio = self.speed
        self._adapt_speed(*speeds, keeps_time or as_reported.KEEPS_TIME in self._core.reported, ratio)
        return ()

    @answers("Scan.FrameGet")
    def _frame(self) -> Answer:
        if as_reported.ROUNDED_READING not in self._core.reported:
            return self.frame
        step_m = as_reported.ROUNDED_M
        x, y = (round(as_reported.SCALE * value / step_m) * step_m for value in self.frame[:2])
        return x, y, *self.frame[2:]

    @answers("Scan.BufferSet")
    def _set_buffer(self, channels: list[int], pixels: int, lines: int) -> Answer:
        # The real controller rounds the pixels of a line to multiples of 16.
        if not all(0 <= channel < 128 for channel in channels) or not 1 <= pixels <= MOST_PIXELS or lines < 0:
            raise FunctionRefused("no such channel or number of pixels")
        if not self._core.takes_all:
            pixels = max(_PIXELS_AT_ONCE, round(pixels / _PIXELS_AT_ONCE) * _PIXELS_AT_ONCE)
        lines = lines or max(1, round(pixels * self.lines / self.pixels))
        # without a limit FrameDataGrab would need more memory than there is (! frame-bounds)
        if pixels * lines > MOST_PIXELS:
            raise FunctionRefused(f"{lines} lines of {pixels} pixels are more than {MOST_PIXELS} pixels")
        if as_reported.FEW_PIXELS in self._core.reported:
            pixels = _PIXELS_AT_ONCE
        self.channels, self.pixels, self.lines = channels or self.channels, pixels, lines
        return ()

    @answers("Scan.BufferGet")
    def _buffer(self) -> Answer:
        chosen_too = [_UNRECORDED] if as_reported.OTHER_LAYOUT in self._core.reported else []
        return [*self.channels, *chosen_too], self.pixels, self.lines

    @answers("Scan.SpeedSet")
    def _set_speed(self, *speed: Any) -> Answer:
        # The quantity to keep: in SpeedSet 1 is the speed and 2 the time, in SpeedGet 0 and 1. The kept quantity
        # determines the other.
        *speeds, keep, ratio = speed
        if not min(speeds) > 0.0 or keep > 2:
            raise FunctionRefused("no such speed")
        self._adapt_speed(*speeds, self.speed[4] if keep == 0 else keep - 1, ratio)
        return ()

    def _adapt_speed(self, forward: float, backward: float, forward_s: float, backward_s: float, *keep: Any) -> None:
        keeps_time, ratio = keep
        width = self.frame[2]
        if keeps_time:
            forward, backward = width / forward_s, width / backward_s
        else:
            forward_s, backward_s = width / forward, width / backward
        self.speed = (forward, backward, forward_s, backward_s, keeps_time, ratio)

    @answers("Scan.SpeedGet")
    def _speed(self) -> Answer:
        return self.speed

    @answers("Scan.PropsSet")
    def _set_properties(
        self, continuous: int, bouncy: int, autosave: int, series: str, comment: str, *rest: Any
    ) -> Answer:
        props = self.properties
        # In PropsSet 0 is no change, 1 on, 2 off.
        props.continuous = bool(chosen(continuous, props.continuous, 1, 0))
        props.bouncy = bool(chosen(bouncy, props.bouncy, 1, 0))
        props.autosave = chosen(autosave, props.autosave, *_AUTOSAVE)
        props.series, props.comment = checked_name(series) or props.series, comment
        if rest:
            props.modules = tuple(rest[0])
        if rest[1:]:
            props.autopaste = chosen(rest[1], props.autopaste, *_PASTES)
        return ()

    @answers("Scan.PropsGet")
    def _properties(self) -> Answer:
        props = self.properties
        counts, table = [1] * len(props.modules), [["Setpoint"] for _ in props.modules]
        # PropsGet counts differently from PropsSet, which has 0 for no change: all 0, next 1, off 2.
        flags = int(props.continuous), int(props.bouncy), _AUTOSAVE.index(props.autosave)
        return *flags, props.series, props.comment, list(props.modules), counts, table, props.autopaste

    # --- images and files ---

    @answers("Scan.FrameDataGrab")
    def _grab(self, channel: int, forward: int) -> Answer:
        last = self.last
        if channel == _UNRECORDED and as_reported.OTHER_LAYOUT in self._core.reported:
            return OtherLayout((self._signals.names[channel], np.zeros((0, 0)), 1))
        if channel not in (last.channels if last else self.channels):
            raise FunctionRefused("the channel is not among the acquired ones")
        if last is None or last.scan.drawing:
            raw, upwards = np.full((self.lines, self.pixels), np.nan), True
        else:
            *_, there, back = self._files.images(last, self._core.now_s)[channel]
            raw, upwards = (there if forward else back[:, ::-1]), last.scan.upwards
        rows = raw if self._rows_as_recorded and upwards else raw[::-1]
        return self._signals.names[channel], np.where(np.isnan(rows), self._unscanned, rows), int(upwards)

    @answers("Scan.Save")
    def _save(self, wait: int, timeout_ms: int) -> Answer:
        if self.last is None:
            raise FunctionRefused("there is no scan to save")
        self._files.save(self.last, self.properties, self._core.now_s)
        return (0,)
