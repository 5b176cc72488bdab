"""`CheckMeasurements`: sets frames, takes scans and spectra, and records all publications meanwhile."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TypeVar

from afspm.basics.clock import Clock
from afspm.basics.units import convert
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Parameter,
    ProbePosition,
    Region,
    RegionChange,
    Scan,
    ScanParameters,
    ScopeState,
    Spectrum,
    names,
)
from afspm.testing.conformance import Check, Failed, Skipped, expect
from afspm.testing.translators.client import CheckClient, Observation, answer_in_words, describe_all, scans, spectra
from afspm.testing.translators.support import Support

NEAR = 1e-3
"""Tolerance in units of the frame's size: less than half a pixel of the largest frame here."""
TURN_RAD = math.radians(20.0)


@dataclass(frozen=True)
class FrameSetting:
    """A region and its pixels, (rows, columns)."""

    region: Region
    shape: tuple[int, int]

    def request(self, support: Support) -> ScanParameters:
        """Return the request for this frame; the angle is left out if the microscope has none."""
        (left, low), (width, height) = self.region.top_left_m, self.region.size_m
        angle = self.region.angle_rad if support.has(names.SCAN_ANGLE) else None
        return ScanParameters(RegionChange(left, low, width, height, angle), self.shape)


@dataclass(frozen=True)
class FrameSettings:
    """The frames of one pass. Column counts are multiples of 16, as some controllers require.

    Attributes:
        whole: the frame set at the beginning, or the square about its centre that the checks must not leave.
    """

    whole: Region

    @property
    def plain(self) -> FrameSetting:
        """A square, off-centre in both directions."""
        return self.part((0.1, -0.15), (0.5, 0.5), (32, 32))

    @property
    def other(self) -> FrameSetting:
        """A smaller square at another position."""
        return self.part((-0.2, 0.2), (0.3, 0.3), (32, 32))

    @property
    def wide(self) -> FrameSetting:
        """A frame twice as wide as high, with another pixel count and pixels twice as high as wide."""
        return self.part((-0.1, 0.15), (0.6, 0.3), (16, 64))

    @property
    def turned(self) -> FrameSetting:
        """A frame rotated counter-clockwise, with square pixels: some scanners have no others."""
        return self.part((0.1, 0.05), (0.5, 0.5 * 31 / 47), (32, 48), TURN_RAD)

    def part(
        self, offset: tuple[float, float], size: tuple[float, float], shape: tuple[int, int], turn_rad: float = 0.0
    ) -> FrameSetting:
        """Return a part of the whole frame; `offset` of the centre and `size` are its fractions, along its own axes."""
        width, height = self.whole.size_m
        side = min(width, height)
        cos, sin = math.cos(self.whole.angle_rad), math.sin(self.whole.angle_rad)
        right, up = offset[0] * side, offset[1] * side
        x, y = self.whole.center_m
        center = (x + cos * right - sin * up, y + sin * right + cos * up)
        return FrameSetting(Region(center, (size[0] * side, size[1] * side), self.whole.angle_rad + turn_rad), shape)


def difference(expected: Region, came: Region) -> str:
    """Describe the difference of two regions; empty if size, angle and centre agree within `NEAR`."""
    size = math.hypot(*expected.size_m)
    if math.dist(expected.size_m, came.size_m) > NEAR * size:
        return f"a size of {in_words(came.size_m)} instead of {in_words(expected.size_m)}"
    turned = math.remainder(came.angle_rad - expected.angle_rad, math.tau)
    if abs(turned) > NEAR:
        return f"an angle of {math.degrees(came.angle_rad):.4g}° instead of {math.degrees(expected.angle_rad):.4g}°"
    if math.dist(expected.center_m, came.center_m) > NEAR * size:
        moved = tuple(b - a for a, b in zip(expected.center_m, came.center_m, strict=True))
        of_size = ", ".join(f"{m / s:+.2f}" for m, s in zip(moved, expected.size_m, strict=True))
        return (
            f"a centre at {in_words(came.center_m)} instead of {in_words(expected.center_m)}: off by ({of_size}) frames"
        )
    return ""


def in_words(xy_m: tuple[float, float]) -> str:
    """Return a position as text, in nm."""
    return "({:.6g}, {:.6g}) nm".format(*(value * 1e9 for value in xy_m))


SCAN_S = 8.0
"""Experiment seconds of a scan, where its speed can be set: long enough to distinguish its start from its end."""
LINE_S = 0.25
"""Least experiment seconds of a line, trace and retrace, far from the limits of any scanner."""
LONG_REAL_S = 3.0
"""Least real seconds of a scan during which requests are sent."""
STOPPED_REAL_S = 40.0
"""Real seconds of a scan that is stopped: it must not end by itself while a busy computer notices its stop."""
UNKNOWN_S = 1200.0
"""Experiment seconds after which a scan or spectrum of unknown duration counts as endless."""

MOST_ROWS = 1024
"""Most lines of a scan whose duration only its lines can set."""

T = TypeVar("T")


def longest_rows(lasts_s: float, line_s: float) -> int:
    """Return the number of lines of a scan of `lasts_s`: a multiple of 16, up to `MOST_ROWS`."""
    return min(MOST_ROWS, 16 * math.ceil(lasts_s / max(line_s, 1e-3) / 16.0))


@dataclass(frozen=True)
class Taken:
    """A finished measurement.

    Attributes:
        frame: the requested frame; None for a spectrum.
        observed: publications from its start until a pause.
        expected_s: its expected duration, experiment time; None if unknown.
    """

    frame: FrameSetting | None
    observed: list[Observation]
    expected_s: float | None

    @property
    def scans(self) -> list[Scan]:
        return scans(self.observed)

    @property
    def spectra(self) -> list[Spectrum]:
        return spectra(self.observed)

    def time_s(self, state: ScopeState) -> float:
        """Return the first time of a state in experiment seconds.

        Raises:
            Failed: the state was not published.
        """
        times = [one.time_ns for one in self.observed if one.state is state and one.time_ns is not None]
        expect(times, f"SS_{state.name} with a time", describe_all(self.observed))
        return times[0] / 1e9


class CheckMeasurements:
    """Measurements for checks. A failed measurement is not repeated: dependent checks are skipped.

    Args:
        frame_m: side of the square that contains the frames to scan; None: the frame set at the beginning.
        excused: checks that this controller can't pass, with the reason.
        complaints: logged warnings and errors; the list grows.

    Attributes:
        set_by_hand: takes the present settings, which a person has made, for those to put back at the end.
        is_withdrawn: whether the tip was withdrawn at the end, and stays so.
        frames: the frames to scan; raises Skipped if the microscope has not published its frame.
    """

    def __init__(
        self,
        client: CheckClient,
        support: Support,
        frame_m: float | None = None,
        *,
        excused: Mapping[str, str] = MappingProxyType({}),
        complaints: Sequence[str] = (),
    ) -> None:
        self.client = client
        self.support = support
        self._excused, self._complaints = excused, complaints
        self._heeded = len(complaints)
        self._kept: dict[str, Taken | Skipped] = {}
        self.is_withdrawn = False
        self.set_by_hand: Callable[[], None] = lambda: None
        self._checked = ""
        initial = client.observations.newest(ScanParameters)
        region = None if initial is None else initial.region
        self._whole = region if isinstance(region, Region) else None
        if self._whole is not None and frame_m is not None:
            self._whole = replace(self._whole, size_m=(frame_m, frame_m))

    @property
    def clock(self) -> Clock:
        return self.client.clock

    def perform(self, check: Check) -> None:
        """Run a check.

        Raises:
            CheckEnded: a check that did not pass; Skipped if the microscope does not support it.
        """
        self._checked, self._heeded = check.name, len(self._complaints)
        if missing := self.support.missing(check.needs):
            raise Skipped(f"not supported: {', '.join(missing)}")
        check.do(self)

    def explain(self, check: Check, failure: Failed) -> tuple[str, ...]:
        """Return the complaints since the check began.

        Raises:
            Skipped: the controller cannot pass the check.
        """
        self.excuse(check.name, failure)
        return tuple(self._complaints[self._heeded :])

    def excuse(self, name: str, failure: Failed) -> None:
        """Raise Skipped if the controller cannot pass the check of this name."""
        if name in self._excused:
            raise Skipped(f"{self._excused[name]}: {failure}")

    def can_pass(self, name: str) -> bool:
        """Return whether the controller is able to pass the check of this name."""
        return name not in self._excused

    @property
    def frames(self) -> FrameSettings:
        if self._whole is None:
            raise Skipped("no ScanParameters2d says which frame is set")
        return FrameSettings(self._whole)

    def keep(self, what: str, taken: Taken) -> None:
        """Store a measurement for later checks."""
        self._kept[what] = taken

    def forget(self) -> None:
        """Discard all stored measurements, so that later checks take them again."""
        self._kept.clear()

    # --- scans ---

    def scan(self, name: str) -> Taken:
        """Return the scan of a named frame; take it on the first call."""
        return self._once(f"scan of the {name} frame", lambda: self.take_scan(getattr(self.frames, name)))

    def take_scan(self, frame: FrameSetting, at_least_s: float = SCAN_S) -> Taken:
        """Take a complete scan that lasts `at_least_s` of experiment time, where its speed can be set."""
        expected_s = self.prepare(frame, max(SCAN_S, at_least_s, LINE_S * frame.shape[0]))
        observed = self._measure(names.START_SCAN, ScopeState.SCANNING, expected_s)
        if not scans(observed):
            raise Failed("a Scan2d between SS_SCANNING and SS_FREE", describe_all(observed))
        return Taken(frame, observed, expected_s)

    def begin_long_scan(self, frame: FrameSetting, lasts_real_s: float = 0.0) -> tuple[int, float | None]:
        """Start a scan long enough for other requests; return the mark before it, and its expected duration.

        Without a scan speed it gets more lines: as many as the time of a line in the scan of the plain frame asks for.
        """
        lasts_real_s = max(LONG_REAL_S * self.client.patience, lasts_real_s)
        lasts_s = max(SCAN_S, lasts_real_s / self.client.clock.real_s(1.0))
        if self.support.parameters.get(names.SCAN_SPEED) is None:
            plain = self.scan("plain")
            line_s = (plain.time_s(ScopeState.FREE) - plain.time_s(ScopeState.SCANNING)) / self.frames.plain.shape[0]
            rows = longest_rows(lasts_s, line_s)
            square = not self.can_pass("scan/not-square")
            frame = replace(frame, shape=(rows, rows if square else frame.shape[1]))
            self.prepare(frame, lasts_s)
            return self._begin(names.START_SCAN, ScopeState.SCANNING), rows * line_s
        expected_s = self.prepare(frame, lasts_s)
        return self._begin(names.START_SCAN, ScopeState.SCANNING), expected_s

    def prepare(self, frame: FrameSetting, lasts_s: float) -> float | None:
        """Set frame and speed for a scan of `lasts_s`.

        Returns:
            the expected duration by the speed in force, experiment seconds; None without a scan speed.
        """
        client = self.client
        client.come_to_rest()
        mark = client.observations.mark()
        client.asked(ControlRequest.SET_SCAN_PARAMS, frame.request(self.support), "setting a frame")
        client.settled(mark)
        if self.support.parameters.get(names.SCAN_SPEED) is None:
            return None
        speed_m_s = 2.0 * frame.region.size_m[0] * frame.shape[0] / lasts_s
        # may be refused: the scan then takes the controller's time
        client.set(names.SCAN_SPEED, f"{speed_m_s:.4g}", "m/s")
        in_force_m_s = number(client.get(names.SCAN_SPEED), "m/s")
        expect(in_force_m_s > 0.0, "a scan-speed above zero", f"{in_force_m_s:g} m/s")
        return 2.0 * frame.region.size_m[0] * frame.shape[0] / in_force_m_s

    # --- spectra ---

    def spectrum(self) -> Taken:
        """Return a spectrum inside the frame; take it on the first call."""
        return self._once("spectrum", self._take_spectrum)

    def begin_spectrum(self) -> int:
        """Start a spectrum; return the mark before it."""
        self.client.come_to_rest()
        return self._begin(names.START_SPEC, ScopeState.SPEC)

    def _take_spectrum(self) -> Taken:
        self.client.come_to_rest()
        if self.support.has(names.PROBE_POS_X, names.PROBE_POS_Y):
            self.move_probe(self.frames.other.region.center_m)
        observed = self._measure(names.START_SPEC, ScopeState.SPEC, None)
        if not spectra(observed):
            raise Failed("a Spec1d between SS_SPEC and SS_FREE", describe_all(observed))
        return Taken(None, observed, None)

    def move_probe(self, xy_m: tuple[float, float], *, awaiting: ScopeState | None = None) -> list[Observation]:
        """Move the probe; return the resulting publications, among them the state that is awaited."""
        self.client.come_to_rest()
        self._set_whole()
        mark = self.client.observations.mark()
        self.client.asked(ControlRequest.SET_PROBE_POS, ProbePosition(xy_m), "moving the probe")
        return self.client.settled(mark, awaiting=awaiting)

    def _set_whole(self) -> None:
        # a failed scan may have left another frame; some controllers move the probe within the scan frame only
        newest, whole = self.client.observations.newest(ScanParameters), self.frames.whole
        if newest is None or not isinstance(newest.region, Region) or not isinstance(newest.shape, tuple):
            return
        if difference(whole, newest.region):
            mark = self.client.observations.mark()
            request = FrameSetting(whole, newest.shape).request(self.support)
            self.client.asked(ControlRequest.SET_SCAN_PARAMS, request, "setting the first frame again")
            self.client.settled(mark)

    # --- both ---

    def act(self, action: str) -> None:
        """Run an action.

        Raises:
            Skipped: an unsupported action, which some microscopes report only on use.
        """
        response = self.client.ask(ControlRequest.ACTION, action)
        if response.code == ControlResponse.ACTION_NOT_SUPPORTED and self.support.actions.get(action) is None:
            self.support.actions[action] = False
            raise Skipped(f"not supported: {action}")
        expect(response.ok, f"REP_SUCCESS to {action}", answer_in_words(response))

    def _begin(self, action: str, state: ScopeState) -> int:
        mark = self.client.observations.mark()
        self.act(action)
        self.client.wait_state(state, mark)
        return mark

    def _measure(self, action: str, state: ScopeState, expected_s: float | None) -> list[Observation]:
        mark = self._begin(action, state)
        limit_s = UNKNOWN_S if expected_s is None else 5.0 * expected_s + 60.0
        self.client.wait_state(ScopeState.FREE, mark, self.client.real_s(limit_s))
        return self.client.settled(mark)

    def _once(self, what: str, take: Callable[[], Taken]) -> Taken:
        found = self._kept.get(what)
        if found is None:
            try:
                found = self._kept[what] = take()
            except Failed:
                self._kept[what] = Skipped(f"the {what} failed, see {self._checked}")
                raise
        if isinstance(found, Skipped):
            raise Skipped(str(found))
        return found


def number(parameter: Parameter, unit: str = "") -> float:
    """Return the value of a parameter in a unit; "" selects the parameter's own unit.

    Raises:
        Failed: the value is not a number.
    """
    try:
        found = float(str(parameter.value))
        return convert(found, parameter.unit or unit, unit) if unit else found
    except ValueError as error:  # an AfspmError of units is a ValueError
        raise Failed(f"a number in {unit or 'its unit'} as the value of {parameter.name}", str(error)) from error
