"""What a scan and a spectrum are made of: what to set before, how to begin, and how to know the result."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from afspm.client.command_retry import CommandRetry
from afspm.client.measurement import MeasurementPlan
from afspm.client.published_state import PublishedState
from afspm.errors import InvalidValue
from afspm.formatting import area_text, position_text
from afspm.model import (
    ControlRequest,
    Frame,
    Parameter,
    ProbePosition,
    Region,
    Scan,
    ScanParameters,
    ScopeState,
    Spectrum,
    names,
)

SAME = 1e-6  # of the size: closer than any controller positions
FITS = 1e-2  # of the size: a controller's rounding, not another region
SPOT_M = 20e-9  # a scanner with sensors tells where the tip was, which is some nanometres from where it was sent
MOVED = 0.5  # of the size: where drift is corrected, a scan lies where it turned out to have been taken
SHEARED = 0.1  # of the size: and is as large, and as turned, as it turned out to be

MEASURED = {"scan": (ScopeState.SCANNING, "Scan2d"), "spectrum": (ScopeState.SPEC, "Spec1d")}
"""By what is measured: the state of the microscope meanwhile, and the message of the results."""


class MeasurementPlans:
    """Makes the plans of one component.

    Args:
        frame: of the places that it speaks of.
    """

    def __init__(self, view: PublishedState, asker: CommandRetry, frame: Frame = Frame.TIP) -> None:
        self._view = view
        self._asker = asker
        self._frame = frame
        self._set: tuple[ScanParameters, ScanParameters | None] | None = None

    def scan(self, region: Region | None, shape: tuple[int, int] | None) -> MeasurementPlan:
        region = self._in_our_frame(region)
        wanted = ScanParameters(region, shape)
        facts = {
            "what": "scan",
            "region": _region_facts(region),
            "shape": None if shape is None else [int(n) for n in shape],
        }
        return MeasurementPlan(
            what="scan",
            action=names.START_SCAN,
            busy=ScopeState.SCANNING,
            message="Scan2d",
            prepare=lambda until_s: self._set_scan(wanted, until_s),
            fits=lambda result: fits(facts, result),
            facts=facts,
            name_of=lambda scan: str(scan.channel),
            words_for=_scan_in_words,
        )

    def spectrum(self, at_m: tuple[float, float] | None, kind: str | None) -> MeasurementPlan:
        at_m = None if at_m is None else _place(at_m)
        facts: dict[str, Any] = {"what": "spectrum", "at_m": None if at_m is None else list(at_m), "kind": kind}
        if self._frame is Frame.SAMPLE:
            facts["frame"] = self._frame.value

        def prepare(until_s: float | None) -> None:
            if kind is not None:
                self._asker.ask(ControlRequest.PARAM, Parameter(names.SPEC_KIND, kind), until_s=until_s)
            if at_m is not None:
                self.move_probe(at_m, until_s)

        return MeasurementPlan(
            what="spectrum",
            action=names.START_SPEC,
            busy=ScopeState.SPEC,
            message="Spec1d",
            prepare=prepare,
            fits=lambda result: fits(facts, result),
            facts=facts,
            name_of=lambda spectrum: "",  # there is one, and the next may be of another kind
            words_for=_spectrum_in_words,
        )

    def move_probe(self, xy_m: tuple[float, float], until_s: float | None) -> None:
        """Move the probe, unless it stands there."""
        xy_m = _place(xy_m)
        now = self._view.probe_position
        if now is not None and now.xy_m == xy_m:
            return
        count = self._view.count("ProbePosition")
        self._asker.ask(ControlRequest.SET_PROBE_POS, ProbePosition(xy_m), until_s=until_s)
        self._asker.settle("ProbePosition", count, until_s)

    def set_scan(self, region: Region, shape: tuple[int, int] | None, until_s: float | None) -> None:
        """Set region and shape of the next scan as a whole, unless they are set."""
        self._set_scan(ScanParameters(self._in_our_frame(region), shape), until_s)

    def _in_our_frame(self, region: Region | None) -> Region | None:
        if isinstance(region, Region) and self._frame is Frame.SAMPLE:
            return replace(region, frame=Frame.SAMPLE)
        return region

    def _set_scan(self, wanted: ScanParameters, until_s: float | None) -> None:
        """Set region and shape, unless they are set."""
        if wanted.region is None and wanted.shape is None:
            return
        # in sample coordinates the same region is another place of the tip a while later
        fixed = not (isinstance(wanted.region, Region) and wanted.region.frame is Frame.SAMPLE)
        now = self._view.scan_parameters
        if fixed and (_is_set(wanted, now, SAME) or (now is not None and (wanted, now) == self._set)):
            return
        count = self._view.count("ScanParameters2d")
        self._asker.ask(ControlRequest.SET_SCAN_PARAMS, wanted, until_s=until_s)
        self._asker.settle("ScanParameters2d", count, until_s)
        # a controller may round: then this is what our wish looks like when it is set; what lies elsewhere is another's
        now = self._view.scan_parameters
        self._set = (wanted, now) if _is_set(wanted, now, FITS) else None


def _place(xy_m: Any) -> tuple[float, float]:
    """(x, y) of two numbers, in whatever they come (an array of numpy is not compared as a tuple is)."""
    try:
        x, y = xy_m
        return float(x), float(y)
    except (TypeError, ValueError) as error:
        raise InvalidValue(f"a place is (x, y) in metres, not {xy_m!r}", hint="e.g. (1e-7, 0)") from error


def fits(facts: dict[str, Any], result: Any) -> bool:
    """Whether a published result can be what a plan of these facts asked for."""
    return _FITS[facts["what"]](facts, result)


def _scan_fits(facts: dict[str, Any], scan: Scan) -> bool:
    if facts["shape"] is not None and list(scan.shape) != facts["shape"]:
        return False
    if facts["region"] is None:
        return True
    *numbers, frame = facts["region"]
    wanted = _region_of(numbers, frame)
    if wanted.frame is Frame.SAMPLE:
        near = math.dist(wanted.center_m, scan.region.center_m) <= MOVED * min(wanted.size_m)
        return near and _is_near(wanted.moved_to(scan.region.center_m), scan.region, SHEARED)
    return _is_near(wanted, scan.region, FITS)


def _spectrum_fits(facts: dict[str, Any], spectrum: Spectrum) -> bool:
    if facts["kind"] is not None and spectrum.kind != facts["kind"]:
        return False
    if facts["at_m"] is None or spectrum.position_m is None or facts.get("frame") == Frame.SAMPLE.value:
        return True
    return math.dist(facts["at_m"], spectrum.position_m) <= SPOT_M


_FITS: dict[str, Callable[[dict[str, Any], Any], bool]] = {"scan": _scan_fits, "spectrum": _spectrum_fits}


def _scan_in_words(scan: Scan) -> str:
    region, (rows, columns) = scan.region, scan.shape
    turned = f", turned by {math.degrees(region.angle_rad):.4g} degrees" if region.angle_rad else ""
    return f"{area_text(region.size_m)} at {position_text(region.center_m)}{turned}, {rows} x {columns} pixels"


def _spectrum_in_words(spectrum: Spectrum) -> str:
    where = "somewhere" if spectrum.position_m is None else f"at {position_text(spectrum.position_m)}"
    return f"{spectrum.kind or 'of no kind'} {where}"


def _region_facts(region: Region | None) -> list[Any] | None:
    if region is None:
        return None
    return [*region.center_m, *region.size_m, region.angle_rad, region.frame.value]


def _region_of(numbers: list[float], frame: str) -> Region:
    x, y, width, height, angle = numbers
    return Region((x, y), (width, height), angle, Frame(frame))


def _is_set(wanted: ScanParameters, now: ScanParameters | None, tolerance: float) -> bool:
    """Whether what is in force is what is wanted, but for `tolerance` of the size."""
    if now is None or (wanted.shape is not None and wanted.shape != now.shape):
        return False
    if not isinstance(wanted.region, Region):
        return wanted.region is None
    return isinstance(now.region, Region) and _is_near(wanted.region, now.region, tolerance)


def _is_near(a: Region, b: Region, tolerance: float) -> bool:
    """Whether two regions differ by less than `tolerance` of their size everywhere."""
    size_m = math.hypot(*a.size_m)
    turned = math.remainder(a.angle_rad - b.angle_rad, math.tau)
    return (
        math.dist(a.center_m, b.center_m) <= tolerance * size_m
        and math.dist(a.size_m, b.size_m) <= tolerance * size_m
        and abs(turned) <= tolerance
    )
