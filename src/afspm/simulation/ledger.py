"""The damage ledger: totals of all actions that can damage tip or sample, as part of the ground truth.

**Theory of operation.** The instrument adds each treatment, scan and interval of time. Whenever the totals have grown,
they are appended to `truth.jsonl` as a separate line. The totals are no verdict: compare them with a budget.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace

from afspm.model import Region

LEDGER_EVENT = "ledger"
PRESSED_FROM_M = 0.2e-9
"""Smallest mean indentation, by errors of the feedback, of a scan that counts: five times the usual indentation."""


@dataclass(frozen=True)
class DamageLedger:
    """Totals since the start.

    Attributes:
        pulses, pulse_v_s: number of bias pulses of an engaged tip, and their integral of |V| over time.
        crashes, crash_depth_m: number of controlled crashes of an engaged tip, and the sum of their depths.
        cured, worsened: treatments that had this effect on the tip.
        marked_m2: area of the marks that treatments left on the sample, each a disc.
        in_keep_away: treatments nearer than `keep_away_m` to a place scanned before.
        pressed_scans, pressed_m: number of scans whose mean indentation was at least `PRESSED_FROM_M`, and the sum of
            these indentations.
        saturated_s: time that the preamplifier was saturated in scans and spectra.
        feedback_off_s: time that the tip was engaged with the feedback off, spectra excluded.
        stage_moves: moves of the coarse stage while the tip was engaged.
        until_s: the experiment time up to which the feedback's time is counted.
    """

    until_s: float
    pulses: int = 0
    pulse_v_s: float = 0.0
    crashes: int = 0
    crash_depth_m: float = 0.0
    cured: int = 0
    worsened: int = 0
    marked_m2: float = 0.0
    in_keep_away: int = 0
    pressed_scans: int = 0
    pressed_m: float = 0.0
    saturated_s: float = 0.0
    feedback_off_s: float = 0.0
    stage_moves: int = 0

    def at(self, now_s: float, *, feedback_off: bool) -> DamageLedger:
        """Return the ledger with the time from `until_s` to `now_s` counted."""
        if now_s <= self.until_s:
            return self
        off_s = now_s - self.until_s if feedback_off else 0.0
        return replace(self, until_s=now_s, feedback_off_s=self.feedback_off_s + off_s)

    def pulsed(self, voltage_v: float, duration_s: float, outcome: str, radius_m: float, *, near: bool) -> DamageLedger:
        """Return the ledger after a pulse that left a mark of `radius_m`; `near`: within `keep_away_m` of a scan."""
        done = replace(self, pulses=self.pulses + 1, pulse_v_s=self.pulse_v_s + abs(voltage_v) * duration_s)
        return done._treated(outcome, radius_m, near=near)

    def crashed(self, depth_m: float, outcome: str, radius_m: float, *, near: bool) -> DamageLedger:
        """Return the ledger after a crash that left a mark of `radius_m`; `near`: within `keep_away_m` of a scan."""
        done = replace(self, crashes=self.crashes + 1, crash_depth_m=self.crash_depth_m + depth_m)
        return done._treated(outcome, radius_m, near=near)

    def _treated(self, outcome: str, radius_m: float, *, near: bool) -> DamageLedger:
        return replace(
            self,
            cured=self.cured + (outcome == "cured"),
            worsened=self.worsened + (outcome == "worsened"),
            marked_m2=self.marked_m2 + math.pi * radius_m**2,
            in_keep_away=self.in_keep_away + near,
        )

    def scanned(self, pressed_m: float, saturated_s: float) -> DamageLedger:
        """Return the ledger after a scan or spectrum with this mean indentation and duration of saturation."""
        pressed = pressed_m >= PRESSED_FROM_M
        return replace(
            self,
            pressed_scans=self.pressed_scans + pressed,
            pressed_m=self.pressed_m + (pressed_m if pressed else 0.0),
            saturated_s=self.saturated_s + saturated_s,
        )

    def line(self) -> dict[str, object]:
        return asdict(self)

    def same_totals(self, other: DamageLedger) -> bool:
        """Return whether two ledgers differ at most in `until_s`."""
        return replace(self, until_s=other.until_s) == other


@dataclass(frozen=True)
class ScannedPlace:
    """A region that was scanned with the tip engaged, and its centre in sample coordinates."""

    region: Region
    sample_xy_m: tuple[float, float]


def distance_m(xy_m: tuple[float, float], region: Region) -> float:
    """Return the distance of a point from a region; 0 within."""
    cos, sin = math.cos(region.angle_rad), math.sin(region.angle_rad)
    dx, dy = xy_m[0] - region.center_m[0], xy_m[1] - region.center_m[1]
    beside = (abs(dx * cos + dy * sin) - region.size_m[0] / 2, abs(dy * cos - dx * sin) - region.size_m[1] / 2)
    return math.hypot(*(max(one, 0.0) for one in beside))


def with_place(places: Iterable[ScannedPlace], place: ScannedPlace) -> list[ScannedPlace]:
    """Return the places with `place` added, instead of an earlier scan of the same frame at the same place."""
    size_m = max(place.region.size_m)

    def same(one: ScannedPlace) -> bool:
        apart_m = math.dist(one.sample_xy_m, place.sample_xy_m)
        return apart_m < 0.05 * size_m and one.region.moved_to(place.region.center_m) == place.region

    return [*(one for one in places if not same(one)), place]
