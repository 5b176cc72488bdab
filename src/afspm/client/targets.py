"""Targets: a scan or spectrum to take, and the check of published results against the target."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from afspm.basics.errors import InvalidValue, UnitError
from afspm.basics.formatting import area_text, position_text
from afspm.basics.plain_data import Plain
from afspm.basics.units import si_or_text
from afspm.model import Frame, Parameter, Region, Scan, ScanParameters, ScopeState, Spectrum, names
from afspm.model.snapshot import from_plain, to_plain

XY = tuple[float, float]

# tolerances, as parts of the size of a region
SAME = 1e-6  # finer than any controller positions
FITS = 1e-2  # a controller's rounding, not another region
SPOT_M = 20e-9  # a scanner with sensors reports the real position of the tip, some nanometres from the requested one
MOVED = 0.5  # with drift correction, a published scan has its measured position
SHEARED = 0.1  # and its measured size and angle


@dataclass(frozen=True)
class ScanTarget:
    """A scan to take; None keeps the present setting.

    Attributes:
        shape: (rows, columns).
        settings: the settings that this measurement states.
        lent: the settings of the blocks around it.
        settle_s: experiment time after a change of bias, setpoint or gains; None: as in [control].
        point: number of the sweep's point; None outside of a sweep.
        aside: the actions (none, too) that move a withdrawn tip away while another instrument goes to its target;
            None: the tip stays.
    """

    region: Region | None
    shape: tuple[int, int] | None
    settings: tuple[Parameter, ...] = ()
    lent: tuple[Parameter, ...] = ()
    settle_s: float | None = None
    point: int | None = None
    aside: tuple[str, ...] | None = None

    what: ClassVar = "scan"
    action: ClassVar = names.START_SCAN
    stop: ClassVar = names.STOP_SCAN
    busy: ClassVar = ScopeState.SCANNING
    message: ClassVar = "Scan2d"

    @classmethod
    def of(cls, region: Region | None, shape: tuple[int, int] | None, frame: Frame) -> ScanTarget:
        if isinstance(region, Region) and frame is Frame.SAMPLE:
            region = replace(region, frame=Frame.SAMPLE)
        if shape is None:
            return cls(region, None)
        try:
            rows, columns = shape
            whole = int(rows), int(columns)
        except (TypeError, ValueError, OverflowError) as error:
            raise InvalidValue(f"a shape is (rows, columns), not {shape!r}", hint="e.g. (256, 256)") from error
        if whole != (rows, columns):  # also texts: a part of a pixel, or "64", is a mistake of the caller
            raise InvalidValue(f"a shape is two whole numbers, not {shape!r}", hint="e.g. (256, 256)")
        return cls(region, whole)

    @property
    def parameters(self) -> ScanParameters:
        return ScanParameters(self.region, self.shape)

    def facts(self) -> Plain:
        """Return the target in JSON's types, so that the component recognises it after a restart."""
        return _facts(self)

    def fits(self, scan: Scan) -> bool:
        """Return whether shape and region of a scan match this target, within the tolerances of a controller."""
        wanted = self.region
        if self.shape is not None and scan.shape != self.shape:
            return False
        if wanted is None:
            return True
        if wanted.frame is Frame.SAMPLE:
            near = math.dist(wanted.center_m, scan.region.center_m) <= MOVED * min(wanted.size_m)
            return near and is_near(wanted.moved_to(scan.region.center_m), scan.region, SHEARED)
        return is_near(wanted, scan.region, FITS)

    def name_of(self, scan: Scan) -> str:
        """Return the scan's channel, which is unique within a result."""
        return scan.channel

    def describe(self, scan: Scan) -> str:
        region, (rows, columns) = scan.region, scan.shape
        turned = f", turned by {math.degrees(region.angle_rad):.4g} degrees" if region.angle_rad else ""
        return f"{area_text(region.size_m)} at {position_text(region.center_m)}{turned}, {rows} x {columns} pixels"


@dataclass(frozen=True)
class SpectrumTarget:
    """A spectrum to take; None keeps the present kind or position of the probe.

    Attributes:
        settings: the settings that this measurement states, such as those of its curve.
        lent: the settings of the blocks around it.
        settle_s: experiment time after a change of bias, setpoint or gains; None: as in [control].
        point: number of the sweep's point; None outside of a sweep.
        aside: the actions (none, too) that move a withdrawn tip away while another instrument goes to its target;
            None: the tip stays.
    """

    at_m: XY | None
    kind: str | None
    frame: Frame = Frame.TIP
    settings: tuple[Parameter, ...] = ()
    lent: tuple[Parameter, ...] = ()
    settle_s: float | None = None
    point: int | None = None
    aside: tuple[str, ...] | None = None

    what: ClassVar = "spectrum"
    action: ClassVar = names.START_SPEC
    stop: ClassVar = names.STOP_SPEC
    busy: ClassVar = ScopeState.SPEC
    message: ClassVar = "Spec1d"

    @classmethod
    def of(cls, at_m: object, kind: str | None, frame: Frame, settings: tuple[Parameter, ...] = ()) -> SpectrumTarget:
        return cls(None if at_m is None else xy_of(at_m), kind, frame, settings)

    def facts(self) -> Plain:
        """Return the target in JSON's types, so that the component recognises it after a restart."""
        return _facts(self)

    def fits(self, spectrum: Spectrum) -> bool:
        """Return whether the kind and position of a spectrum match this target.

        A position in sample coordinates, and an unknown position, count as a match.
        """
        if self.kind is not None and spectrum.kind != self.kind:
            return False
        if self.at_m is None or spectrum.position_m is None or self.frame is Frame.SAMPLE:
            return True
        return math.dist(self.at_m, spectrum.position_m) <= SPOT_M

    def name_of(self, spectrum: Spectrum) -> str:
        """Return an empty name, since a result has only one spectrum."""
        return ""

    def describe(self, spectrum: Spectrum) -> str:
        where = "somewhere" if spectrum.position_m is None else f"at {position_text(spectrum.position_m)}"
        return f"{spectrum.kind or 'of no kind'} {where}"


Target = ScanTarget | SpectrumTarget


def _facts(target: Target) -> Plain:
    facts = to_plain(target)
    # the key has the number; how a target is reached changes no result, and a block may be edited before a resume
    del facts["point"], facts["aside"], facts["lent"], facts["settle_s"]
    if not target.settings:
        del facts["settings"]
    return {"what": target.what, **facts}


def target_from(facts: Plain) -> Target:
    """Return the target from its `facts()`."""
    kind = SpectrumTarget if facts["what"] == SpectrumTarget.what else ScanTarget
    target: Target = from_plain(kind, {name: value for name, value in facts.items() if name != "what"})
    return target


def xy_of(xy_m: Any) -> XY:
    """Return a position, from numbers or text with units, as (x, y) in m.

    Raises:
        InvalidValue, UnitError: the position is not valid.
    """
    try:
        x, y = xy_m
        place_m = si_or_text(x, "m"), si_or_text(y, "m")
        if not all(map(math.isfinite, place_m)):
            raise ValueError("not finite")
    except UnitError:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidValue(
            f"a place is (x, y), finite and in metres, not {xy_m!r}", hint='e.g. (1e-7, 0) or ("100 nm", 0)'
        ) from error
    return place_m


def is_set(wanted: ScanParameters, now: ScanParameters | None, tolerance: float) -> bool:
    """Return whether region and shape of the wanted parameters are in force: the region as in `is_near`."""
    if now is None or (wanted.shape is not None and wanted.shape != now.shape):
        return False
    if not isinstance(wanted.region, Region):
        return wanted.region is None
    return isinstance(now.region, Region) and is_near(wanted.region, now.region, tolerance)


def is_near(a: Region, b: Region, tolerance: float) -> bool:
    """Return whether two regions agree: centres and sizes to `tolerance` times the diagonal of `a`, angles in rad."""
    size_m = math.hypot(*a.size_m)
    turned = math.remainder(a.angle_rad - b.angle_rad, math.tau)
    return (
        math.dist(a.center_m, b.center_m) <= tolerance * size_m
        and math.dist(a.size_m, b.size_m) <= tolerance * size_m
        and abs(turned) <= tolerance
    )
