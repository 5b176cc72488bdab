"""Setting frames, and taking scans and spectra, with everything that is published meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TypeVar

from afspm.model import (
    ControlRequest,
    ControlResponse,
    Parameter,
    ProbePosition,
    Region,
    Scan,
    ScanParameters,
    ScopeState,
    Spectrum,
    names,
)
from afspm.testing.translators.bench import Bench, answer_in_words
from afspm.testing.translators.frames import Frame, Frames
from afspm.testing.translators.story import Heard, scans, spectra, told
from afspm.testing.translators.support import Support
from afspm.testing.translators.verdicts import Failed, Skipped, expect
from afspm.units import convert

SCAN_S = 8.0
"""Experiment seconds that a scan is to last, where its speed can be set: long enough to tell its start from its end."""
LINE_S = 0.25
"""Experiment seconds that a line, there and back, is to last at least: no scanner is driven to its limits."""
LONG_REAL_S = 3.0
"""Real seconds that a scan has to last at least in the middle of which something is asked."""
UNKNOWN_S = 1200.0
"""Experiment seconds after which a scan or spectrum of unknown duration is said not to end."""

T = TypeVar("T")


@dataclass(frozen=True)
class Taken:
    """A measurement that was taken.

    Attributes:
        frame: that was set; of a spectrum: None.
        heard: from its beginning on until all was quiet.
        expected_s: how long, by its speed, it should have lasted, experiment time; None if that is not known.
    """

    frame: Frame | None
    heard: list[Heard]
    expected_s: float | None

    @property
    def scans(self) -> list[Scan]:
        return scans(self.heard)

    @property
    def spectra(self) -> list[Spectrum]:
        return spectra(self.heard)

    def time_s(self, state: ScopeState) -> float:
        """When it was first in a state, experiment time.

        Raises:
            Failed: never.
        """
        times = [one.time_ns for one in self.heard if one.state is state and one.time_ns is not None]
        expect(times, f"SS_{state.name} with a time", told(self.heard))
        return times[0] / 1e9


class Taking:
    """Takes measurements for checks. What failed once is not tried again: who needs it is skipped.

    Attributes:
        excused: checks that this controller can't pass, with the reason.
        complaints: what is logged as wrong; it grows.
        frames: to take scans of; Skipped where the microscope has not said what is set.
            `frame_m` is the side of what they are parts of, instead of the frame that is set.
    """

    def __init__(
        self,
        bench: Bench,
        support: Support,
        frame_m: float | None = None,
        *,
        excused: Mapping[str, str] = MappingProxyType({}),
        complaints: Sequence[str] = (),
    ) -> None:
        self.bench = bench
        self.support = support
        self.excused, self.complaints = excused, complaints
        self._kept: dict[str, Taken | Exception] = {}
        initial = bench.story.newest(ScanParameters)
        region = None if initial is None else initial.region
        self._whole = region if isinstance(region, Region) else None
        if self._whole is not None and frame_m is not None:
            self._whole = replace(self._whole, size_m=(frame_m, frame_m))

    @property
    def frames(self) -> Frames:
        if self._whole is None:
            raise Skipped("no ScanParameters2d says which frame is set")
        return Frames(self._whole)

    # --- scans ---

    def scan(self, name: str) -> Taken:
        """The scan of the frame of this name, taken now unless it was before."""
        return self._once(f"scan of the {name} frame", lambda: self.take_scan(getattr(self.frames, name)))

    def take_scan(self, frame: Frame) -> Taken:
        """Take a scan, to its end."""
        expected_s = self.prepare(frame, max(SCAN_S, LINE_S * frame.shape[0]))
        heard = self._measure(names.START_SCAN, ScopeState.SCANNING, expected_s)
        if not scans(heard):
            raise Failed("a Scan2d between SS_SCANNING and SS_FREE", told(heard))
        return Taken(frame, heard, expected_s)

    def begin_long_scan(self, frame: Frame) -> int:
        """Begin a scan that lasts long enough to ask something meanwhile; where the story was before it."""
        self.prepare(frame, max(SCAN_S, LONG_REAL_S / self.bench.clock.real_s(1.0)))
        return self._begin(names.START_SCAN, ScopeState.SCANNING)

    def prepare(self, frame: Frame, lasts_s: float) -> float | None:
        """Set frame and speed; how long, by that, the scan lasts."""
        bench = self.bench
        bench.come_to_rest()
        mark = bench.story.mark()
        bench.asked(ControlRequest.SET_SCAN_PARAMS, frame.request(self.support), "setting a frame")
        bench.settled(mark)
        if self.support.parameters.get(names.SCAN_SPEED) is None:
            return None
        speed_m_s = 2.0 * frame.region.size_m[0] * frame.shape[0] / lasts_s
        bench.set(names.SCAN_SPEED, f"{speed_m_s:.4g}", "m/s")  # if that is refused, it lasts as long as it does
        in_force_m_s = number(bench.get(names.SCAN_SPEED), "m/s")
        expect(in_force_m_s > 0.0, "a scan-speed above zero", f"{in_force_m_s:g} m/s")
        return 2.0 * frame.region.size_m[0] * frame.shape[0] / in_force_m_s

    # --- spectra ---

    def spectrum(self) -> Taken:
        """A spectrum somewhere in the frame, taken now unless one was before."""
        return self._once("spectrum", self._take_spectrum)

    def begin_spectrum(self) -> int:
        """Begin one; where the story was before it."""
        self.bench.come_to_rest()
        return self._begin(names.START_SPEC, ScopeState.SPEC)

    def _take_spectrum(self) -> Taken:
        self.bench.come_to_rest()
        if self.support.has(names.PROBE_POS_X, names.PROBE_POS_Y):
            self.move_probe(self.frames.other.region.center_m)
        heard = self._measure(names.START_SPEC, ScopeState.SPEC, None)
        if not spectra(heard):
            raise Failed("a Spec1d between SS_SPEC and SS_FREE", told(heard))
        return Taken(None, heard, None)

    def move_probe(self, xy_m: tuple[float, float]) -> list[Heard]:
        """Move the probe; what is published of it."""
        self.bench.come_to_rest()
        mark = self.bench.story.mark()
        self.bench.asked(ControlRequest.SET_PROBE_POS, ProbePosition(xy_m), "moving the probe")
        return self.bench.settled(mark)

    # --- both ---

    def act(self, action: str) -> None:
        """Have it done. Some microscopes can't be asked what they support: this tells."""
        response = self.bench.ask(ControlRequest.ACTION, action)
        if response.code == ControlResponse.ACTION_NOT_SUPPORTED and self.support.actions.get(action) is None:
            self.support.actions[action] = False
            raise Skipped(f"not supported: {action}")
        expect(response.ok, f"REP_SUCCESS to {action}", answer_in_words(response))

    def _begin(self, action: str, state: ScopeState) -> int:
        mark = self.bench.story.mark()
        self.act(action)
        self.bench.wait_state(state, mark)
        return mark

    def _measure(self, action: str, state: ScopeState, expected_s: float | None) -> list[Heard]:
        mark = self._begin(action, state)
        limit_s = UNKNOWN_S if expected_s is None else 5.0 * expected_s + 60.0
        self.bench.wait_state(ScopeState.FREE, mark, self.bench.real_s(limit_s))
        return self.bench.settled(mark)

    def _once(self, what: str, take: Callable[[], Taken]) -> Taken:
        found = self._kept.get(what)
        if found is None:
            try:
                found = self._kept[what] = take()
            except Failed as failure:
                self._kept[what] = failure
                raise
        if isinstance(found, Exception):
            raise Skipped(f"there is no {what}, as was told before")
        return found


def number(parameter: Parameter, unit: str = "") -> float:
    """The value of a parameter in a unit, "" for its own.

    Raises:
        Failed: it is none.
    """
    try:
        found = float(str(parameter.value))
        return convert(found, parameter.unit or unit, unit) if unit else found
    except ValueError as error:  # an AfspmError of units is one
        raise Failed(f"a number in {unit or 'its unit'} as the value of {parameter.name}", str(error)) from error
